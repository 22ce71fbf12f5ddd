"""MiniLAMP's and BenJr's messages and motions, in virtual time; then with real sockets and a real broker."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.commands import app
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation.trace import read_trace
from tests.ext.lab.simulation.virtual_network import Session, VirtualBroker
from tests.firmware.drill import BASE, DRIVE, ESTOP, LIMIT_S, RESET, STALE_S, STATE, Drill
from tests.firmware.test_deadman_virtual import HOSTILE
from tests.firmware.wireless_rig import Robots
from tests.robot.operator import Operator
from tests.support import ROOT, SOON_S, WAIT_S, Broker, Child, quickly, until
from tests.tcp_proxy import TcpProxy
from wifi import sockets

KINDS = ("minilamp", "benjr")
WEEK_S = 7 * 86_400.0  # more than half a period of the ticks
EPOCH_MS = 1_800_000_000_000  # of the virtual time server at virtual time 0
AHEAD = {"minilamp": (1.0, 1.0, 0.0), "benjr": (-0.5, -0.5)}


def online(kind: str, seed: int = 1, *, refused: Iterable[str] = (), security: Any = None) -> Drill:
    """A robot that is connected; ``refused`` topics cannot be subscribed to, ``security`` is that of its settings."""
    drill = Drill(kind, seed)
    drill.broker.refused = set(refused)
    if security is not None:
        base = {"robot": {"id": "rover"}, "wifi": {"ssid": "home"}, "mqtt": {"host": "10.0.0.2"}}
        drill.robot = drill.board.load(kind, {**base, "security": security})
    while drill.robot.session.connection.state != "online":
        drill.turn(0.01)
        assert drill.seconds < 30, drill.robot.session.connection.reason
    drill.wait(0.5)
    return drill


@pytest.mark.parametrize("kind", KINDS)
def test_a_group_moves_a_board_that_lists_it_as_its_drive_command_would(kind: str) -> None:
    drill = online(kind)
    (capabilities,) = published(drill, "capabilities")
    lists = capabilities["value"].get("groups") == ["drive-values"]
    assert lists is (kind == "minilamp"), "benjr has little room"
    (capabilities,) = published(online(kind, refused={f"{BASE}/incoming/group"}), "capabilities")
    assert "groups" not in capabilities["value"]
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]
    group = b'{"drive-values":{"z":1.0,"valid_ms":400}}'
    for body, moves in ((group[:-1] + b',"estop":{}}', False), (group, lists), (group, False)):
        drill.broker.publish(f"{BASE}/incoming/group", body, qos=1)
        drill.wait(0.2)
        assert any(drill.outputs()) is moves
        drill.wait(0.4)
        assert not any(drill.outputs()), "for as long as it is valid"
        if moves is lists:
            drill.stop()  # so that the last one does not move it
            drill.wait(0.3)


def published(drill: Drill, metric: str) -> list[Any]:
    return [json.loads(payload) for payload in drill.received(f"{BASE}/outgoing/{metric}")]


@pytest.mark.parametrize("kind", KINDS)
def test_its_capabilities_are_a_retained_message(kind: str) -> None:
    drill = online(kind)
    (message,) = [one.message for one in drill.broker.received if one.message.topic == f"{BASE}/outgoing/capabilities"]
    assert message.retain
    body = json.loads(message.payload)
    value, absent = body["value"], {"available": False, "controls": False}
    assert body["schema"] == "pebble-capabilities/v1"
    assert value["identity"] == {"system": "pebble", "type": "robots", "id": "rover"}
    assert value["telemetry"]["charging_level_topic"] == f"{BASE}/outgoing/charging-level"
    assert value["telemetry"]["charging_status"] is (kind == "benjr")
    drive = {"available": True, "controls": True, "arbitrates": True, "control": True, "topic": DRIVE}
    assert value["drive"] == drive | {"axes": ["x", "z", *(["y"] if kind == "minilamp" else [])]}
    topics = {"topic": ESTOP, "reset_topic": RESET, "owners": ["mcu"], "status_topics": [STATE]}
    assert value["estop"] == {"available": True, **topics}
    assert [value[name] for name in ("video", "audio", "soundboard", "autonomy")] == [absent] * 4
    assert value["system"] == dict.fromkeys(("reboot", "service_restart", "git_pull"), absent)


def test_its_client_id_is_its_own_and_as_long_as_any_broker_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that knows it can disconnect the robot. It lasts until the next boot, to end an old connection."""
    ids: list[str] = []
    accept = VirtualBroker.taken_over

    def taken_over(broker: VirtualBroker, by: Session) -> None:
        ids.append(by.client_id)
        accept(broker, by)

    monkeypatch.setattr(VirtualBroker, "taken_over", taken_over)
    drill = online("benjr")
    drill.broker.drop_all()
    drill.wait(10)
    online("benjr", seed=2)
    assert len(ids) == 3
    assert ids[0] == ids[1] != ids[2]
    assert all(re.fullmatch("pebble-[0-9a-f]{16}", one) for one in ids)


@pytest.mark.parametrize("kind", KINDS)
def test_the_battery_every_five_seconds_and_not_retained(kind: str) -> None:
    drill = Drill(kind, 1)
    drill.board.set_volts(drill.board.firmware.module(f"{kind}.pins").BATTERY, 0.8)
    drill.run(20)
    levels = [one.message for one in drill.broker.received if one.message.topic.endswith("charging-level")]
    assert 3 <= len(levels) <= 4
    assert not any(message.retain for message in levels)
    volts = json.loads(levels[0].payload)
    assert volts["unit"] == "v"
    assert volts["value"] == pytest.approx({"minilamp": 1.6, "benjr": 3.6}[kind], abs=0.01)
    assert published(drill, "charging-status") == ([{"value": False}] * len(levels) if kind == "benjr" else [])


def test_it_reconnects_after_more_days_than_ticks_can_measure() -> None:
    drill = online("benjr")
    drill.wait(5)
    drill.broker.kill()
    while drill.seconds < WEEK_S:
        drill.turn(30.0)
    drill.network.conditions.ntp = "silent"
    drill.broker.start()
    drill.wait(15)
    assert drill.robot.session.connection.state == "online"
    assert abs(EPOCH_MS + drill.clock.now() * 1000 - published(drill, "online")[-1]["t"]) < 500


def test_a_backlog_does_not_drive_a_robot() -> None:
    """More commands than the board can read, for seconds: what it reads gets older and older."""
    drill = online("minilamp")
    drill.clock.watch = lambda: None
    end = drill.seconds + 6.0
    while drill.seconds < end + STALE_S + LIMIT_S:
        for _ in range(120 if drill.seconds < end else 0):
            drill.command(0.0, 1.0, qos=0)
        drill.clock.advance(0.04)
        drill.network.step()
        drill.robot.step()
    assert not any(drill.outputs())


def test_who_loses_the_broker_stops_at_once() -> None:
    drill = online("minilamp")
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.network.radio.lose()
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.session.connection.state == "offline"


def test_a_stop_is_repeated_until_the_shield_acknowledges_it() -> None:
    drill = online("benjr")
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    drill.failing_i2c(2.0)
    drill.wait(1.9)
    assert any(drill.outputs())  # the shield did not receive it
    drill.board.bus.restore(0x30)
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.deadman.trips == 1


@pytest.mark.parametrize("kind", KINDS)
def test_settings_that_are_missing_are_named_when_the_motors_are_off(kind: str) -> None:
    drill = online(kind)
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())
    with pytest.raises(ValueError, match=r"robot\.id"):
        drill.board.load(kind, {})
    assert not any(drill.outputs())


def test_a_certificate_needs_the_date() -> None:
    drill = Drill("minilamp", 1)
    wrapper = drill.board.firmware.module("wifi.tls").Wrapper({"ca": "/ca.der"})
    wrapper.set_time(5_000)  # since boot
    assert drill.board.rtc[0] == 2000
    wrapper.set_time(1_700_000_000_999)
    assert drill.board.rtc == (2023, 11, 14, 1, 22, 13, 20, 0)
    wrapper.set_time(4_200_000_000_000)  # a time server's nonsense
    assert drill.board.rtc[0] == 2023


def test_every_address_of_its_broker_has_a_turn_and_the_one_that_worked_comes_again() -> None:
    drill = Drill("minilamp", 1)
    order = ("10.0.0.9", "10.0.0.1", "10.0.0.2")  # the broker has the second one by number
    drill.network.hosts = {"fleet.test": order, "pool.ntp.org": "10.0.0.3"}
    settings = {"robot": {"id": "rover"}, "wifi": {"ssid": "home"}, "mqtt": {"host": "fleet.test"}}
    drill.robot = drill.board.load("minilamp", settings)
    drill.run(40)
    assert drill.robot.session.connection.state == "online"
    losses = drill.robot.session.connection.losses
    assert losses <= 3
    drill.broker.drop_all()
    drill.wait(5)
    assert (drill.robot.session.connection.state, drill.robot.session.connection.losses) == ("online", losses + 1)


@pytest.mark.parametrize(
    ("asked", "answers", "received"),
    [
        ("8.8.8.8", "8.8.8.8", b"answer"),
        ("85.1.2.3", "8.8.8.8", b""),
        ("224.0.0.251", "192.168.1.7", b"answer"),
    ],
)
def test_only_who_was_asked_may_answer(
    monkeypatch: pytest.MonkeyPatch, asked: str, answers: str, received: bytes
) -> None:
    module = Mock(**{"socket.return_value.recvfrom.return_value": (b"answer", (answers, 53))})
    monkeypatch.setattr(sockets, "socket", module)
    assert sockets.Query(asked, 53, b"question", 0).step(0) == received


def test_what_tls_could_not_send_comes_again_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    write = Mock(side_effect=(None, None, 9, 9))
    monkeypatch.setattr(sockets, "socket", Mock(**{"socket.return_value.write": write}))
    monkeypatch.setattr(sockets, "select", Mock())
    stream, data = sockets.Stream("10.0.0.2", 1883, None), memoryview(b"heartbeat and more")
    assert [stream.write(data, count) for count in (9, 18, 18)] == [0, 0, 9]  # more waits by now
    assert stream.write(data[9:], 9) == 9
    assert [bytes(call.args[0]) for call in write.call_args_list] == [b"heartbeat"] * 3 + [b" and more"]


# -- with real sockets and a real broker: as programs


NAME = 'The "lamp", naïve'  # as JSON must escape it


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The file with what all programs print."""
    return tmp_path / "log"


@pytest.fixture
def start(log: Path) -> Iterator[Any]:
    programs: list[Child] = []

    def start(kind: str, broker: str, *options: str) -> Child:
        command = [sys.executable, "-m", "pebble.cli", "sim", kind, "--broker", broker, *options]
        with log.open("ab") as out:
            programs.append(Child(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT))
        return programs[-1]

    yield start
    for program in programs:
        program.kill()
        program.wait()


def test_one_is_driven_and_ends_at_once_by_a_signal_with_motors_off(
    start: Any, broker: Broker, tmp_path: Path, log: Path
) -> None:
    address, trace = f"127.0.0.1:{broker.port}", tmp_path / "trace.jsonl"
    program = start("minilamp", f"mqtt://{address}", "--name", NAME, "--trace", str(trace))

    def motors() -> list[Any]:
        return [entry.motors for entry in read_trace(trace)]

    with closing(Operator(broker.port, "pebble/robots/minilamp")) as operator:
        assert until(lambda: len(operator.on("outgoing/online")) > 1), log.read_text()
        operator.send("incoming/drive-values", {"z": 1.0})
        assert until(lambda: motors() == [(1.0, 1.0), (0.0, 0.0)])
        began, ended = read_trace(trace)
        assert 0.8 <= (ended.ns - began.ns) / 1e9 < SOON_S  # after the last command
        assert f"connected to the broker at {address}" in log.read_text()
        identity = operator.on("outgoing/capabilities")[-1].json["value"]["identity"]
        assert identity == {"system": "pebble", "type": "robots", "id": "minilamp", "name": NAME}
        operator.send("incoming/drive-values", {"z": 1.0})
        assert until(lambda: motors()[-1] == (1.0, 1.0))
        program.terminate()
        with quickly():
            assert program.wait(WAIT_S) == 0
        assert motors()[-1] == (0.0, 0.0)


def test_its_files_survive_a_killed_program_which_is_published_as_offline(
    start: Any, broker: Broker, tmp_path: Path, log: Path
) -> None:
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"robot": {"id": "benjr"}, "local_mqtt": {"host": "127.0.0.1", "port": broker.port}}))
    arguments = ("benjr", str(config), "--files", str(tmp_path / "board"))
    program = start(*arguments)
    with closing(Operator(broker.port, "pebble/robots/benjr")) as operator:

        def became(metric: str, **fields: Any) -> bool:
            """Wait until the newest message has these fields."""
            return until(
                lambda: any(fields.items() <= one.json.items() for one in operator.on(f"outgoing/{metric}")[-1:])
            )

        assert became("estop/mcu", latched=False), log.read_text()
        operator.send("incoming/estop", {"stop": "00000000000000aa"})
        assert became("estop/mcu", latched=True, persisted=True)
        program.kill()
        program.wait()
        assert became("online", t=0, online=False)
        start(*arguments)
        assert became("estop/mcu", latched=True, count=0, recent=["00000000000000aa"])


def test_a_fleet_takes_turns_of_kinds_shows_its_status_and_ends_in_order(start: Any, broker: Broker, log: Path) -> None:
    with closing(Operator(broker.port, "pebble/robots")) as operator:
        program = start("fleet", f"mqtt://127.0.0.1:{broker.port}", "-n", "3")
        assert until(lambda: "3 robots: connected" in log.read_text()), log.read_text()
        robots = {"minilamp-001", "benjr-001", "minilamp-002"}
        assert until(lambda: robots <= {message.topic.split("/")[2] for message in operator.seen})
    program.terminate()
    with quickly():
        assert program.wait(WAIT_S) == 0
    assert "3 of 3 online" in log.read_text()
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("benjr", "nowhere.json"), "nowhere.json"),
        (("fleet", "mqtt://127.0.0.1", "-n", "1001"), "1000"),
        (("minilamp", "mqtt://127.0.0.1", "a/b"), "robot.id"),
        (("benjr", "mqtts://127.0.0.1"), "memory"),
    ],
)
def test_what_makes_no_sense_is_one_line(options: tuple[str, ...], named: str) -> None:
    kind, broker, *more = options
    with pytest.raises(PebbleError) as error:
        app.run(["sim", kind, "--broker", broker, *more])
    assert named in str(error.value)
    assert len(str(error.value).splitlines()) == 1


# -- whatever arrives or fails, motors are off in time


HUGE = (b'{"x": 0, "z": 1, "pad": "' + b"x" * 100_000 + b'"}', b"[" * 100_000, b'{"z": 1' + b"0" * 900 + b"}")


@pytest.mark.parametrize("fault", ["black hole", "broker killed"])
def test_motors_stop_by_themselves_and_nothing_retained_or_hostile_moves_them(fault: str, tmp_path: Path) -> None:
    """After a second, which test_deadman_virtual measures."""
    with ExitStack() as stack:
        broker = Broker(tmp_path)
        stack.callback(broker.kill)
        link = stack.enter_context(TcpProxy(broker.port))
        operator = stack.enter_context(closing(Operator(broker.port, "pebble/robots", "+/outgoing/online")))

        def send(body: Any, **options: Any) -> float:
            """Publish a drive command to each robot; return when the broker has it."""
            for info in [operator.send(f"{kind}/incoming/drive-values", body, **options) for kind in KINDS]:
                info.wait_for_publish(WAIT_S)
            return time.monotonic()

        def beating() -> bool:
            """Wait until each robot has sent three more heartbeats."""
            since = time.monotonic()
            return until(lambda: all(len(operator.on(f"{kind}/outgoing/online", since)) > 2 for kind in KINDS))

        def moving() -> list[str]:
            return [kind for kind in KINDS if robots.moving(kind)]

        send({"x": 0, "z": 1}, retain=True)
        robots = stack.enter_context(Robots(link.port))
        robots.wait_online()
        for number, payload in enumerate((*HOSTILE, *HUGE)):
            send(payload, qos=number % 2)
        assert beating()
        assert [robots.moves[kind] for kind in KINDS] == [[], []]
        last = send({"x": 0, "z": 0.8})
        assert until(lambda: moving() == [*KINDS])
        (link.blackhole if fault == "black hole" else broker.kill)()
        assert until(lambda: not moving())
        for kind in KINDS:
            assert robots.stopped_at(kind) - last < SOON_S, kind
        assert until(lambda: not any(robot.online for robot in robots.robots.values()))
        moves = {kind: len(moves) for kind, moves in robots.moves.items()}
        (link.resume if fault == "black hole" else broker.start)()
        robots.wait_online(20.0)
        assert beating()
        assert {kind: len(moves) for kind, moves in robots.moves.items()} == moves
        assert until(lambda: send({"x": 0, "z": 0.8}) and moving() == [*KINDS], step=0.05)
        assert robots.alive
