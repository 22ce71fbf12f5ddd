"""Faults while an operator drives: the wheels stop in time, no stale command moves them, and driving resumes."""

from __future__ import annotations

import itertools
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from pebble.config import LAUNCHER_LOCK
from tests.robot.operator import Driver, Operator, number_of, retained_messages
from tests.robot.rig import BASE, STOP, Rig
from tests.support import until

pytestmark = pytest.mark.alone  # deadlines are checked

STOP_LIMIT_S = 1.0  # after the last command seen at the pty: 0.75, and what a busy machine may add
AGE_LIMIT_S = 2.5  # no older command ever reaches the pty
BACK_LIMIT_S = 5.0  # after the fault's end commands reach the wheels again

_numbers = itertools.count(1, 2000)
_drivers: list[Driver] = []


class Drive:
    """One drive through a fault, and what must be true of it afterwards."""

    def __init__(self, rig: Rig, operator: Operator | None = None) -> None:
        self.rig = rig
        self.began = time.monotonic()
        self.driver = Driver(operator or rig.operator, first=next(_numbers))
        _drivers.append(self.driver)
        assert until(lambda: rig.mcu.moving(self.began), 5), "the robot did not even start to move"

    def end(self, fault_over: float) -> None:
        """Commands sent after the fault get through soon; then the driver stops sending."""
        assert until(lambda: self._arrived_after(fault_over), BACK_LIMIT_S), "no driving within 5 s of the fault's end"
        assert min(at for at, _ in self._commands(fault_over)) - fault_over <= BACK_LIMIT_S
        self.finish()

    def finish(self) -> None:
        self.driver.stop()
        assert until(lambda: not self.rig.mcu.moving(self.began), 3)
        self._check_ages()

    def check_stops(self, *, excused: tuple[float, float] = (0.0, 0.0)) -> None:
        """Every movement is followed by another line in time, except across ``excused`` (from, to)."""
        drives = self.rig.mcu.drives(self.began)
        for (at, wheels), (then, _) in itertools.pairwise(drives):
            if wheels != STOP and not excused[0] <= then <= excused[1]:
                assert then - at <= STOP_LIMIT_S, f"{wheels} was left running for {then - at:.3f} s"
        assert drives[-1][1] == STOP

    def _check_ages(self) -> None:
        for at, number in self._commands(self.began):
            age = at - self.driver.sent_at[number]
            assert age <= AGE_LIMIT_S, f"command {number} moved the wheels {age:.2f} s after it was sent"

    def _commands(self, since: float) -> list[tuple[float, int]]:
        return [(at, number_of(*wheels)) for at, wheels in self.rig.mcu.drives(since) if wheels != STOP]

    def _arrived_after(self, since: float) -> bool:
        return any(self.driver.sent_at[number] >= since for _, number in self._commands(since))


@pytest.fixture(autouse=True)
def retained_state_is_current_afterwards(driven: Rig) -> Iterator[None]:
    """After every fault a late subscriber finds all retained state, and all of it is current."""
    charging = (
        driven.operator.last("outgoing/charging-status") or driven.operator.wait_for("outgoing/charging-status")
    ).json
    change = not charging["value"]
    driven.charge_later = "charge" if change else "discharge"
    yield
    for driver in _drivers:  # of a test that failed half-way
        driver.stop()
    assert until(lambda: _retained_is_current(driven, change), 10), retained_messages(driven.remote.port, BASE)


def _retained_is_current(rig: Rig, charging: bool) -> bool:
    retained = {topic: json.loads(raw) for topic, raw in retained_messages(rig.remote.port, BASE, 0.3).items()}
    services = retained.get("outgoing/status", {}).get("value", {}).get("services", {})
    return (
        retained.get("outgoing/charging-status") == {"value": charging}
        and "outgoing/capabilities" in retained
        and bool(services)
        and {service["state"] for service in services.values()} == {"ready"}
        and abs(retained["outgoing/online"]["t"] / 1000 - time.time()) < 2
        and retained["outgoing/online"].get("online") is not False
    )


@contextmanager
def fault(rig: Rig) -> Iterator[None]:
    """The time of the fault; what the MCU reports changes in the middle of it."""
    yield
    rig.mcu.command(rig.charge_later)


def test_serial_bridge_killed(driven: Rig) -> None:
    drive = Drive(driven)
    with fault(driven):
        killed = driven.kill("serial_mcu_bridge")
        assert until(lambda: _opened(driven, killed), 3)
    reopened = _opened(driven, killed)
    assert reopened - killed <= 1.0, "the serial bridge was not back within 1 s"
    drive.end(reopened)
    first_at, first_wheels = driven.mcu.drives(reopened)[0]
    assert first_wheels == STOP
    assert first_at - reopened <= 0.3
    drive.check_stops(excused=(killed, reopened + 0.3))


@pytest.mark.parametrize("program", ["mqtt_bridge", "announcer"])
def test_another_process_killed(driven: Rig, program: str) -> None:
    drive = Drive(driven)
    with fault(driven):
        killed = driven.kill(program)
    drive.end(killed)
    drive.check_stops()


def test_run_directory_removed(driven: Rig) -> None:
    """All programs start again, and the lock is held again."""
    drive, run = Drive(driven), driven.folder / "run"
    sockets = len(list(run.glob("*.seat")))
    with fault(driven):
        shutil.rmtree(run)
        assert until(lambda: (run / LAUNCHER_LOCK).exists() and len(list(run.glob("*.seat"))) >= sockets)
    drive.end(time.monotonic())


def test_local_transport_killed(driven: Rig) -> None:
    """The local broker is killed and restarted; on Zenoh the hub, whose death must not interrupt driving."""
    drive = Drive(driven)
    with fault(driven):
        back = _kill_local_transport(driven)
    drive.end(back)
    drive.check_stops()


def test_remote_broker_restarted(driven: Rig) -> None:
    drive = Drive(driven)
    with fault(driven):
        driven.remote.kill()
        driven.remote.start()
    drive.end(time.monotonic())
    drive.check_stops()


@pytest.mark.parametrize("seconds", [3, *(pytest.param(seconds, marks=pytest.mark.thorough) for seconds in (6, 10))])
def test_uplink_cut(driven: Rig, seconds: float) -> None:
    drive = Drive(driven)
    with fault(driven):
        driven.uplink.blackhole()
        time.sleep(seconds / 2)
    time.sleep(seconds / 2)
    driven.uplink.resume()
    drive.end(time.monotonic())
    drive.check_stops()


def test_uplink_cut_and_the_operator_dies_meanwhile(driven: Rig) -> None:
    operator = Operator(driven.remote.port, BASE)
    drive = Drive(driven, operator)
    with fault(driven):
        driven.uplink.blackhole()
        time.sleep(1)
    drive.driver.stop()
    operator.drop()
    time.sleep(2)
    restored = time.monotonic()
    driven.uplink.resume()
    heartbeat = driven.operator.wait_for("outgoing/online", since=restored + 0.5)
    assert not driven.mcu.moving(heartbeat.at)
    drive.finish()
    drive.check_stops()


def test_serial_port_unplugged(driven: Rig) -> None:
    drive = Drive(driven)
    with fault(driven):
        unplugged = time.monotonic()
        driven.mcu.command("unplug")
        time.sleep(3)
        replugged = time.monotonic()
        driven.mcu.command("replug")
    drive.end(replugged)
    first_at, first_wheels = driven.mcu.drives(replugged)[0]
    assert first_wheels == STOP
    drive.check_stops(excused=(unplugged, first_at))


def test_launcher_killed_and_started_again(driven: Rig) -> None:
    drive = Drive(driven)
    with fault(driven):
        killed = time.monotonic()
        children = driven.kill_launcher()
        assert until(lambda: not any(driven.alive(pid) for pid in children), 1.0), (
            "children outlived their launcher by 1 s"
        )
        stopped_at, wheels = driven.mcu.drives(killed)[-1]
        assert wheels == STOP
        assert stopped_at - killed <= 1.0
        restarted = driven.start(ready=False)
    drive.end(restarted)
    drive.check_stops()
    driven.wait_until_up(restarted)


def _opened(rig: Rig, since: float) -> float:
    """When the MCU saw the port opened after ``since``; 0 if not yet."""
    return next((entry.ns / 1e9 for entry in rig.mcu.entries(since) if entry.event == "opened"), 0.0)


def _kill_local_transport(rig: Rig) -> float:
    kill: Callable[[], object] = rig.kill_local_broker if rig.local is not None else lambda: rig.kill("zenoh_hub")
    kill()
    return time.monotonic()
