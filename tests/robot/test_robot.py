"""What an operator may expect of a robot on any transport, from any of its brokers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from tests.commands.command_line import program
from tests.kit.stalls import lost_s, stalls
from tests.robot.conftest import Station
from tests.robot.operator import Operator, driving, retained_messages
from tests.robot.rig import BASE, STOP, Rig
from tests.support import SOON_S, further, gone, until

pytestmark = pytest.mark.alone  # deadlines are checked

DRIVE = "incoming/drive-values"
COMMANDS: dict[str, Any] = {
    "incoming/drive-values": {"x": 0, "z": 1},
    "incoming/lights-solid": {"r": 1},
    "incoming/flags/reboot": True,
    "incoming/flags/git-pull": {"value": True},
    "incoming/flags/service-restart": {"enabled": True},
    "incoming/soundboard-command": {"action": "play", "file": "a.wav"},
    "incoming/autonomy-command": {"action": "start", "file": "x"},
    "incoming/not-in-the-contract": {"x": 1},
}
OLD_STOP = {"incoming/estop": {"stop": "00000000000000a0"}}


def retain_messages(port: int, messages: dict[str, Any]) -> None:
    """Publish retained messages to a broker, and wait until it has them."""
    publisher = Operator(port, BASE)
    for topic, body in messages.items():
        publisher.send(topic, body, retain=True)
    assert until(lambda: set(retained_messages(port, BASE, 0.2)) >= set(messages))
    publisher.close()


@pytest.mark.parametrize("kind", ["mqtt", "zenoh", further("single"), further("mirror")])
def test_what_is_retained_does_nothing_and_a_live_stop_that_asks_to_be_retained_stops(kind: str) -> None:
    """Neither at the start, nor when the uplink comes back. Afterwards the broker has the live stop, now old."""
    state = "outgoing/estop/serial"
    with Rig(kind.replace("mirror", "zenoh"), mirror=kind == "mirror", start=False) as rig:
        retain_messages(rig.remote.port, COMMANDS | OLD_STOP)
        if rig.local is not None:
            retain_messages(rig.local.port, OLD_STOP)
        rig.start()
        for _ in range(2):
            assert not rig.operator.wait_for(state).json["latched"]
            assert_untouched(rig)
            rig.uplink.drop()
            rig.operator.wait_for("outgoing/online", since=time.monotonic() + 0.3)
        if rig.local is not None:
            assert not set(retained_messages(rig.local.port, BASE)) & set(COMMANDS)
        began = time.monotonic()
        assert until(lambda: _turns(rig, began))
        assert not any(seen.json["latched"] or seen.json["count"] for seen in rig.operator.on(state))
        assert until(lambda: _is_stopped(rig, state), step=0.2)
        stopped = time.monotonic()
        assert not until(lambda: _turns(rig, stopped), 1)


def assert_untouched(rig: Rig) -> None:
    """Nothing happened, not even after a live command that followed the retained ones has been carried out."""
    began = time.monotonic()

    def flashes() -> bool:
        rig.operator.send("incoming/lights-flash", {"g": 0.5})
        return until(lambda: any(entry.line[:1] == "F" for entry in rig.mcu.entries(began)), 1)

    assert until(flashes), "no live command was carried out"
    assert not [entry.line for entry in rig.mcu.entries() if entry.line[:1] == "L"]
    assert not [wheels for _, wheels in rig.mcu.drives() if wheels != (0.0, 0.0)]
    assert rig.recorded() == []


def _is_stopped(rig: Rig, state: str) -> bool:
    """Whether the robot has latched a stop sent now, or an earlier one of the same name."""
    rig.operator.send("incoming/estop", {"stop": "00000000000000a1", "by": "test"}, retain=True)
    latched = [seen.json["recent"] for seen in rig.operator.on(state) if seen.json["latched"]]
    return latched[-1:] == [["00000000000000a1"]]


def _turns(rig: Rig, since: float) -> bool:
    """Whether a wheel turns for a command sent now."""
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.5})
    time.sleep(0.05)
    return any(wheels != (0.0, 0.0) for _, wheels in rig.mcu.drives(since))


def pebble(*arguments: object) -> tuple[int, str]:
    process = program(*map(str, arguments))
    out, err = process.communicate(timeout=90)
    return process.returncode, out + err


def test_a_stop_that_comes_once_while_the_motor_owner_restarts_holds_without_a_bridge() -> None:
    with Rig("single", start=False, mqtt_bridge={"enabled": False}) as rig:
        rig.start(ready=False)
        assert until(lambda: rig.operator.newest("estop/serial").get("latched") is False)
        rig.operator.wait_for("outgoing/status")  # of the process that repeats stops, sent after its subscriptions
        rig.kill("serial_mcu_bridge")
        rig.operator.send("incoming/estop", {"by": "ann"})
        assert until(lambda: rig.operator.newest("estop/serial")["by"] == "ann")


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_a_stop_from_either_side_holds_over_restarts_until_its_reset(kind: str) -> None:
    with Rig(kind) as rig:
        remote = f"--url=mqtt://127.0.0.1:{rig.remote.port}"
        with driving(rig.operator, 0.5):
            assert until(rig.mcu.moving)
            code, printed = pebble("estop", BASE, remote, "--why", "dog")
            stopped = time.monotonic()
            assert (code, "stopped and confirmed after" in printed) == (0, True), printed
            rig.kill("serial_mcu_bridge")
            assert until(lambda: rig.processes().get("serial_mcu_bridge"))
            rig.stop()
            rig.start()
            assert {wheels for _, wheels in rig.mcu.drives(stopped)} <= {STOP}
            code, printed = pebble("topic", "pub", "drive-values", '{"z": 0.5}', "-c", rig.config)
            assert (code, "is stopped by" in printed, ": dog" in printed) == (1, True, True), printed
        code, printed = pebble("estop", "reset", rig.config)  # on the robot's own transport
        assert code == 0, printed
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})  # without it the robot waits for half a second
        with driving(rig.operator, 0.5):
            assert until(rig.mcu.moving)
            code, printed = pebble("estop", rig.config)
            assert code == 0, printed
            assert not rig.mcu.moving()
        code, printed = pebble("estop", "reset", BASE, remote)
        assert (code, "stopped by" in printed) == (0, True), printed
        assert pebble("estop", "status", remote) == (0, f"{BASE.rpartition('/')[2]}: free\n")


def stop_and_wait(station: Station) -> None:
    """Send a stop until it reaches the wheels: a serial line and a mirror open late."""
    began = time.monotonic()

    def stands() -> bool:
        return station.rig.mcu.drives(began) and not station.rig.mcu.moving()

    assert until(lambda: station.operator.send(DRIVE, {"x": 0, "z": 0}) and until(stands, 1))


def test_silence_stops_the_wheels(station: Station) -> None:
    watch = stalls()
    stop_and_wait(station)
    began = time.monotonic()
    station.operator.send(DRIVE, {"x": 0.1, "z": 0.3})
    assert until(lambda: station.rig.mcu.moving(began))
    assert until(lambda: not station.rig.mcu.moving(began))
    lines = iter(station.rig.mcu.drives(began))
    started = next(at for at, wheels in lines if wheels != STOP)
    stopped = next(at for at, wheels in lines if wheels == STOP)  # after it in order: a zero may have its time
    assert stopped - began >= 0.75, "a line may be read late on a busy machine"
    assert stopped - started - lost_s(watch.found, started, stopped) < 1.0, "later the MCU stops by itself"


def test_actions_run_once_and_only_for_true(station: Station) -> None:
    before = len(station.rig.recorded())
    for body in (False, {"value": False}, 1, "true", {"value": 1}, None, {"on": True}, b"true\xff"):
        station.operator.send("incoming/flags/reboot", body)
    station.operator.send("incoming/flags/reboot", True, retain=True)
    station.operator.send("incoming/flags/reboot", b"", retain=True)
    station.operator.send("incoming/flags/service-restart", {"enabled": True})
    assert until(lambda: len(station.rig.recorded()) > before)
    assert station.rig.recorded()[before:] == ["service_restart"]


# -- the way to the remote broker


def test_four_heartbeats_a_second(uplinked: Station) -> None:
    began = time.monotonic()
    assert until(lambda: len(uplinked.operator.on("outgoing/online", began)) >= 9)
    heartbeats = uplinked.operator.on("outgoing/online", began)[:9]
    assert 1.5 <= heartbeats[-1].at - heartbeats[0].at < SOON_S
    assert abs(heartbeats[-1].json["t"] / 1000 - time.time()) < 3
    assert "outgoing/online" in retained_messages(uplinked.rig.remote.port, BASE)


def test_the_launcher_forks_its_programs_so_it_has_one_thread_and_only_its_own_sockets(uplinked: Station) -> None:
    launcher = Path(f"/proc/{uplinked.rig.launcher_pid}")
    assert len(list((launcher / "task").iterdir())) == 1
    opened = [path.readlink().name for path in (launcher / "fd").iterdir()]
    sockets = [name for name in opened if name.startswith("socket:")]
    assert len(sockets) == 3, "two for its stop signals, one to the announcer"


def test_stopping_the_robot_stops_the_wheels_and_reports_offline(uplinked: Station) -> None:
    rig = uplinked.rig
    began = time.monotonic()
    uplinked.operator.send(DRIVE, {"x": 0, "z": 0.5})
    assert until(lambda: rig.mcu.moving(began))
    left_behind = rig.processes()
    assert rig.stop() == 0
    assert until(lambda: not rig.mcu.moving(began)), "the last line that the board got was no stop"
    assert until(lambda: (last := uplinked.operator.last("outgoing/online")) and last.json.get("online") is False)
    assert all(map(gone, left_behind.values()))
    rig.start()
