"""The motor bridge on a real pty, in memory and at a broker that refuses subscriptions: its lines and messages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.contract import CONTROL, CONTROL_TAKE, CONTROL_VOUCHED, DRIVE, ESTOP, ESTOP_RESET
from pebble.contract.payloads import ControlRequest, Drive
from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.runtime.process import view_of
from pebble.services.serial_mcu_bridge.line.holders import holders
from pebble.services.serial_mcu_bridge.line.port import Port
from pebble.services.serial_mcu_bridge.line.starts import Starts
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.transports import Message, MqttSettings, QoS, State, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.hall_reader import HallReader
from tests.kit.robot import BASE as BASE
from tests.kit.robot import ROBOT, Listener, Running, handled
from tests.support import WAIT_S, Broker, RefusingBroker, errors, until

STOP = {"stop": "c9a9f10cc9a9f10c", "by": "eve", "why": "a test"}
STOPPED = "M 0.000 0.000"


class Bench:
    """The service in a thread of its own, an MCU, and an operator on the same network: in memory, or at a broker.

    It is the motor owner ``instance`` of the robot; ``peer`` is listed as another one.
    """

    def __init__(
        self,
        folder: Path,
        kind: str,
        *,
        broker: Broker | None = None,
        instance: str = "",
        peer: str = "",
        groups: bool = False,
        **section: Any,
    ) -> None:
        folder.mkdir(exist_ok=True)
        self._owner = instance or "serial"
        self.mcu = PtyMcu(kind, folder / "tty")
        self.mcu.__enter__()
        serial = {"enabled": True, "serial": {"port": str(folder / "tty")}, **section}
        lines = {instance: serial}
        if peer:
            lines[peer] = {**serial, "serial": {"port": str(folder / peer)}}
        serial = {"instances": lines} if instance else serial
        transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
        bridge = {
            "enabled": True,
            "remote_mqtt": {"host": "localhost", "port": 1},
            "link": {"groups": groups},
        }  # beside one, silence alone ends no control
        services = {"serial_mcu_bridge": serial, "mqtt_bridge": bridge}
        raw = {"robot": {"id": ROBOT}, "transport": transport, "services": services}
        config = parse(raw, folder=folder, env={})
        config = view_of(config, instance) if instance else config
        settings: Any = MemoryHub() if broker is None else MqttSettings(host="127.0.0.1", port=broker.port)
        network, self.network = "memory" if broker is None else "mqtt", settings
        self.world = Listener(create(network, "operator", settings))
        self.operator = self.world.transport
        name = f"robot-{instance}"
        self.service = MotorBridge(config, create(network, name, settings), instance=instance)
        self._running = Running(self.service)
        assert until(lambda: len(self.lines) >= 2)  # the stop after opening and after booting

    @property
    def lines(self) -> list[str]:
        """What the MCU has received."""
        return self.mcu.trace.lines()

    def send(self, metric: str, body: Any) -> None:
        self.world.command(metric, body)

    def drive(self, z: float = 0.0, **more: Any) -> None:
        self.send("drive-values", {"z": z, **more})

    def moves(self, z: float, **more: Any) -> bool:
        """Drive straight, and wait until the MCU is told so."""
        self.drive(z, **more)
        return self.line(f"M {z:.3f} {z:.3f}")

    def shines(self, **colours: float) -> bool:
        """Switch the lights on, and wait until the MCU is told so: what was sent before has been handled."""
        self.send("lights-solid", colours)
        return self.line("L " + " ".join(f"{colours.get(name, 0):.3f}" for name in "bgr"))

    def payloads(self, metric: str) -> list[Any]:
        return self.world.payloads(metric)

    def line(self, text: str) -> bool:
        return until(lambda: text in self.lines)

    @property
    def state(self) -> dict[str, Any]:
        """The newest state of the emergency stop."""
        state: dict[str, Any] = self.world.newest(f"estop/{self._owner}")
        return state

    def stopped(self) -> bool:
        return until(lambda: self.state.get("latched") and self.state["persisted"])

    def reset(self) -> bool:
        self.send("estop-reset", {"boot": self.state["boot"], "count": self.state["count"], "by": "eve"})
        return until(lambda: not self.state["latched"])

    def close(self) -> None:
        self._running.stop()
        self.operator.close()
        self.mcu.__exit__(None, None, None)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    kind, section = getattr(request, "param", ("goob", {}))
    with closing(Bench(tmp_path, kind, **section)) as bench:
        yield bench


ANN = {"id": "aaaaaaaa", "by": "ann", "device": "phone"}


@pytest.mark.parametrize("bench", [("goob", {"safety": {"drive_timeout_seconds": 0.2}})], indirect=True)
def test_the_configured_watchdog_stops_once(bench: Bench) -> None:
    sent = time.monotonic()
    assert bench.moves(0.5)
    moved = next(entry for entry in bench.mcu.trace.entries() if entry.line == "M 0.500 0.500")
    assert until(lambda: bench.lines[-1] == STOPPED)
    stopped = bench.mcu.trace.entries()[-1]
    assert stopped.ns / 1e9 - sent >= 0.2
    assert (stopped.ns - moved.ns) / 1e9 < 0.65  # the default is 0.75
    time.sleep(0.3)  # one more timeout: the stop is not repeated
    assert bench.mcu.trace.entries()[-1] == stopped


def test_after_a_pause_of_the_process_the_stop_is_sent_before_the_next_command(bench: Bench) -> None:
    """The order is that after SIGSTOP and SIGCONT: the watchdog is overdue, and a command is handled first."""
    assert bench.moves(0.5)

    def pause() -> None:
        time.sleep(0.9)
        bench.service.receive_drive(Drive(x=0.0, z=0.25), bench.service.clock())
        bench.service.judge()

    bench.service.post(pause)
    assert bench.line("M 0.250 0.250")
    assert bench.lines[-3:] == ["M 0.500 0.500", STOPPED, "M 0.250 0.250"]


def test_a_second_program_at_the_port_is_named_until_it_has_gone(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """As the original, whose unit is still enabled: it asks for no lock."""
    port = str(bench.service.options.serial.port)
    program = (
        "import os, sys, time; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(1, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, port], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"1\n"
        for _ in range(2):
            bench.service.name_holders()
            assert until(lambda: f"{port} is open in another program, too: process {other.pid} (python" in caplog.text)
        other.kill()
    assert until(lambda: holders(port) == [])
    assert caplog.text.count("is open in another program") == 1
    with pytest.raises(DeviceError, match=r"another program has it open$"):  # the bridge itself is no other one
        Port(port, 115200)


@pytest.mark.parametrize("bench", [("fred", {"telemetry": {"publish_touch_sensors": True}})], indirect=True)
def test_every_field_of_a_line_is_published_and_what_the_motors_get_again_while_they_run(bench: Bench) -> None:
    """An odometry that begins while a robot drives steadily learns in which direction."""
    assert until(lambda: bench.payloads("touch-sensors") and bench.payloads("charging-status"))
    assert set(bench.payloads("touch-sensors")[0]["value"]) == {"a0", "a1", "a2"}
    bench.mcu.charge(True)
    assert until(lambda: bench.payloads("charging-status")[-1] == {"value": True})
    assert bench.payloads("charging-status") == [{"value": False}, {"value": True}], "changes alone are published"
    began = time.monotonic()
    assert until(lambda: bench.drive(0.5) or len(bench.payloads("motor-power/serial")) >= 3)
    assert time.monotonic() - began > 0.9, "at most twice a second"
    assert {tuple(power.values()) for power in bench.payloads("motor-power/serial")} == {(0.5, 0.5)}
    assert until(lambda: bench.payloads("motor-power/serial")[-1] == {"left": 0.0, "right": 0.0})


def test_what_a_board_says_at_its_start_counts(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[float] = []
    monkeypatch.setattr(Starts, "began", lambda _starts, now: starts.append(now))
    assert until(lambda: bench.mcu.reset() or starts, step=0.2)


def test_a_drive_command_without_an_axis_is_logged_once_for_each_sender(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(60):
        bench.send("drive-values", {"linear": {"x": 1}, "source": f"s{number % 3}"})
        bench.send("drive-values", {"X": number})
    for number in range(1000):
        bench.send("drive-values", {"Z": 1, "source": f"stranger {number}"})
    assert bench.moves(0.25)
    lines = [record.getMessage() for record in caplog.records if "none of x, z and y" in record.getMessage()]
    assert [sum(f"from {name!r}" in line for line in lines) for name in ("s0", "s1", "s2")] == [1, 1, 1]
    assert sum("'X'" in line for line in lines) == 1
    assert len(lines) == 17  # 16 senders, and all others together
    assert "'linear', 'source'" in lines[0]


def test_stops_are_subscribed_to_before_drive_commands() -> None:
    assert handled(MotorBridge)[:5] == [ESTOP, ESTOP_RESET, CONTROL, CONTROL_TAKE, DRIVE]


def test_robots_with_one_state_directory_do_not_share_a_stop(tmp_path: Path) -> None:
    def bridge(robot: str) -> MotorBridge:
        serial = {"enabled": True, "serial": {"port": "/dev/null"}}
        transport = {"kind": "mqtt", "state_dir": str(tmp_path)}
        raw = {"robot": {"id": robot}, "transport": transport, "services": {"serial_mcu_bridge": serial}}
        return MotorBridge(parse(raw, folder=tmp_path, env={}), MemoryTransport(robot, MemoryHub()))

    stopped, other = bridge("rover"), bridge("other")
    stopped.state_file.save({"latched": True})
    stopped.state_file.close()
    assert (stopped.state_file.load(), other.state_file.load()) == ({"latched": True}, None)


def test_a_stop_that_is_repeated_for_another_listed_owner_is_ignored(tmp_path: Path) -> None:
    with closing(Bench(tmp_path, "goob", instance="left", peer="right")) as bench:
        assert until(lambda: bench.world.on("estop/left"))
        bench.send("estop", {"stop": "a" * 16, "owner": "right"})
        bench.send("control", ANN)  # judged after it
        assert bench.world.became("control/left", by="ann")
        assert not bench.state["latched"]
        for number, owner in enumerate(({"owner": "left"}, {"owner": "else"}, {}), start=1):
            bench.send("estop", {"stop": f"{number:016x}", **owner})
            assert bench.world.became("estop/left", latched=True, count=number)


def test_a_drive_command_that_waited_renews_control_before_the_silence_counts(bench: Bench) -> None:
    bench.send("control", {**ANN, "for_ms": 1000})
    assert bench.world.became("control/serial", by="ann")
    key, began = bench.world.newest("control/serial")["key"], time.monotonic()
    assert until(lambda: time.monotonic() > began + 1.1)
    blocked, go_on, counters = threading.Event(), threading.Event(), bench.service.transport.counters

    def stand_still() -> None:
        blocked.set()
        go_on.wait(WAIT_S)

    bench.service.post(stand_still)
    assert blocked.wait(WAIT_S)
    delivered = counters["delivered"]
    bench.drive(0.5, key=key)
    vouched = b'{"from": 0, "to": %d}' % (1000 * time.monotonic())
    assert bench.operator.publish(CONTROL_VOUCHED.topic(BASE), vouched)
    assert until(lambda: counters["delivered"] == delivered + 2)
    go_on.set()
    assert bench.line("M 0.500 0.500")


#: After what the silence of the holder may be a loss on the way.
LOST: dict[str, Callable[[Bench], object]] = {
    "a late drive command": lambda bench: bench.service.receive_drive(Drive(z=0.5), bench.service.clock() - 1.0),
    "a late request": lambda bench: bench.service.receive_request(
        ControlRequest(id="bbbbbbbb"), bench.service.clock() - 10.0
    ),
    "a connection": lambda bench: (bench.network.stop(), bench.network.start()),
}


@pytest.mark.parametrize("lost", LOST)
def test_after_a_loss_no_silence_until_then_ends_control(bench: Bench, lost: str) -> None:
    bench.send("control", {**ANN, "for_ms": 1000})
    assert bench.world.became("control/serial", by="ann")
    began = time.monotonic()
    assert until(lambda: time.monotonic() > began + 1.1)
    LOST[lost](bench)
    vouched = b'{"from": 0, "to": %d}' % (1000 * time.monotonic())
    assert until(lambda: bench.operator.publish(CONTROL_VOUCHED.topic(BASE), vouched))
    bench.send("control", {"id": "cccccccc", "by": "otto"})
    assert bench.world.became("control/serial", by="ann", asks="otto")


# -- groups of commands: one write on the serial line, or nothing

HALF, LIGHTS = {"z": 0.5}, {"r": 0.2, "g": 0.7, "b": 1}
_COLOURS = (number / 1000 for number in count(1))  # each once
MOVED, LIT = "M 0.500 0.500", "L 1.000 0.700 0.200"


@pytest.fixture(scope="module")
def grouped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with closing(Bench(tmp_path_factory.mktemp("groups"), "goob", groups=True)) as bench:
        yield bench


def lines_of(bench: Bench, metric: str, body: Any, least: int = 1) -> list[str]:
    """The lines that a command brings, ``least`` if any, after those of a zero and before those of plain lights."""
    bench.drive(0.0)
    assert bench.shines(b=next(_COLOURS))
    before = len(bench.lines)
    bench.send(metric, body)
    until(lambda: len(bench.lines) >= before + least, 0.3)  # the next lights replace those that wait
    assert bench.shines(b=next(_COLOURS))
    return bench.lines[before:-1]


@pytest.mark.parametrize(
    ("metric", "body", "lines"),
    [
        ("group", {"lights-solid": LIGHTS, "drive-values": HALF}, [MOVED, LIT]),
        ("group", {"drive-values": {"z": 0}, "lights-solid": LIGHTS}, [STOPPED, LIT]),
        ("group", {"lights-solid": LIGHTS}, [LIT]),
        ("group", {"drive-values": HALF, "lights-solid": LIGHTS, "estop-reset": {"boot": "", "count": 1}}, []),
        ("group", {"drive-values": {"z": 0.5, "key": "stranger"}, "lights-solid": LIGHTS}, []),
        ("drive-values", HALF | {"group": True}, []),
        ("drive-values", {"z": 0, "group": True}, [STOPPED]),
        ("lights-solid", LIGHTS | {"group": True}, []),
    ],
)
def test_a_group_is_obeyed_at_once_and_its_copies_are_not(
    grouped: Bench, metric: str, body: Any, lines: list[str]
) -> None:
    brought = lines_of(grouped, metric, body, len(lines) or 1)
    assert list(dict.fromkeys(brought)) == lines, "a zero may be repeated"


def test_no_member_is_obeyed_while_the_robot_is_stopped(grouped: Bench) -> None:
    grouped.send("estop", STOP)
    assert grouped.stopped()
    lines = lines_of(grouped, "group", {"drive-values": HALF, "lights-solid": LIGHTS})
    grouped.reset()
    assert set(lines) <= {STOPPED}


def test_without_the_key_groups_are_nothing_and_copies_are_commands(bench: Bench) -> None:
    assert MOVED not in lines_of(bench, "group", {"drive-values": HALF, "lights-solid": LIGHTS})
    assert MOVED in lines_of(bench, "drive-values", HALF | {"group": True})


# -- a broker that refuses some subscriptions


STOPS, RESETS = ESTOP.topic(BASE), ESTOP_RESET.topic(BASE)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[RefusingBroker]:
    broker = RefusingBroker(tmp_path)
    yield broker
    broker.stop()


@pytest.fixture
def start(broker: RefusingBroker, tmp_path: Path) -> Iterator[Callable[[], Bench]]:
    """Its commands are valid for longer than the tests take."""
    made: list[Bench] = []

    def make() -> Bench:
        made.append(Bench(tmp_path, "goob", broker=broker, safety={"drive_timeout_seconds": 5}))
        assert until(lambda: made[0].service.transport.state is State.CONNECTED)
        return made[0]

    yield make
    for bench in made:
        bench.close()


def refuse(broker: RefusingBroker, bench: Bench, *filters: str) -> None:
    clients = (bench.operator, bench.service.transport)
    before = [client.counters["connected"] for client in clients]
    broker.refuse(*filters)
    assert until(lambda: all(client.counters["connected"] > n for client, n in zip(clients, before, strict=True)))


def retained(broker: RefusingBroker) -> list[Any]:
    """The states that a new client receives."""
    found: list[Message] = []
    with create("mqtt", "observer", MqttSettings(host="127.0.0.1", port=broker.port)) as client:
        client.subscribe(f"{BASE}/outgoing/estop/+", found.append, direct=True)
    return [json.loads(message.payload) for message in found if message.payload]


def test_without_both_subscriptions_there_is_no_emergency_stop(
    broker: RefusingBroker, start: Callable[[], Bench], caplog: pytest.LogCaptureFixture
) -> None:
    broker.refuse(STOPS)
    bench = start()
    assert until(lambda: errors(caplog))
    assert until(lambda: retained(broker) == [], step=0.1)
    old = f"{BASE}/outgoing/estop/serial"  # as a broker has it that was restored from an older save
    assert bench.operator.publish(old, b'{"latched": false}', qos=QoS.DELIVERED, retain=True)
    assert until(lambda: b'{"latched": false}' in [message.payload for message in bench.world.received])
    bench.service.post(bench.service.repeat_state)
    assert until(lambda: retained(broker) == [], step=0.1)
    (error,) = errors(caplog)
    assert f"refuses the subscription to {STOPS}: this robot has no emergency stop" in error
    assert f"to subscribe to both {STOPS} and {RESETS}" in error
    assert bench.moves(0.5)


def test_a_stop_that_could_not_be_reset_is_a_final_zero(broker: RefusingBroker, start: Callable[[], Bench]) -> None:
    broker.refuse(RESETS)
    bench = start()
    bench.send("drive-values", {"z": 0.125, "source": "autonomy", "run": 7})
    assert bench.moves(0.5)
    bench.send("estop", STOP)
    assert until(lambda: bench.lines[-1] == STOPPED)
    assert bench.moves(0.25)
    refuse(broker, bench)
    assert until(lambda: retained(broker), step=0.1)
    (granted,) = retained(broker)
    assert (granted["latched"], granted["count"], granted["recent"], granted["barred"]) == (False, 0, [], 7)


def test_a_stop_from_before_the_refusal_stays_and_is_back_when_all_is_granted(
    broker: RefusingBroker, start: Callable[[], Bench], caplog: pytest.LogCaptureFixture
) -> None:
    bench = start()
    bench.send("estop", STOP)
    assert bench.stopped()
    before = bench.state
    refuse(broker, bench, STOPS)
    assert until(lambda: errors(caplog))
    assert "it stays stopped now" in errors(caplog)[0]
    assert until(lambda: retained(broker) == [], step=0.1)
    bench.drive(0.25)
    assert until(lambda: bench.service.counters["latched"] == 1)
    assert "M 0.250 0.250" not in bench.lines
    refuse(broker, bench)
    assert until(lambda: retained(broker) == [before], step=0.1)
    assert bench.reset()
    bench.send("drive-values", {})
    assert bench.moves(0.125)


def is_whole(path: Path) -> bool:
    """Programs of the original try again, too, while it is being made."""
    try:
        HallReader(path.name)
    except (FileNotFoundError, ValueError):
        return False
    return True


def test_a_bridge_keeps_every_line_of_its_board_whether_or_not_it_publishes_them(tmp_path: Path) -> None:
    path = Path("/dev/shm") / f"pebble-test-{os.getpid()}-{time.monotonic_ns()}"
    bench = Bench(tmp_path, "goob", odometry_shm={"name": path.name})
    try:
        assert until(lambda: is_whole(path))
        reader = HallReader(path.name)
        assert until(lambda: reader.newest >= 20)
        samples = reader.read()
        numbers = [sample.number for sample in samples]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert abs(samples[-1].at_ns - time.monotonic_ns()) < 5_000_000_000
        assert bench.payloads("touch-sensors") == []
    finally:
        bench.close()
        path.unlink(missing_ok=True)
