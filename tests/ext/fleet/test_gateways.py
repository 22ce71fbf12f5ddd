"""Gateways as processes: two of one robot, the first of which is killed; and one of a board, which goob drives.

The board has its real firmware, and goob its real `neighbours` and no wheels.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ONLINE
from pebble.extensions.fleet.commands.gateway import gateway
from pebble.extensions.scripts.script import Robot
from pebble.transports import Message, MqttSettings, QoS, Transport, ZenohSettings, create
from pebble.transports.memory import MemoryTransport
from tests.ext.neighbours.test_service import One
from tests.firmware.wireless_rig import Robots
from tests.support import SOON_S, WAIT_S, Broker, free_port, until
from tests.transports.forked import Forked
from tests.transports.zenoh_net import HubProcess

pytestmark = pytest.mark.alone
STOP_S = 1.0
ROBOT = "pebble/robots/r0"


def main(file: str) -> int:
    """`pebble fleet gateway` in a forked process."""
    return gateway(Path(file))


class Gateways:
    """A hub, a broker of operators and a client there; gateways are started."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.broker = Broker(folder)
        stack.callback(self.broker.kill)
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        hub = HubProcess(folder / "hub")
        hub.settings = ZenohSettings(run_dir=folder / "hub", listen=(self.endpoint,))
        stack.callback(hub.start().kill)
        operator = MqttSettings(host="127.0.0.1", port=self.broker.port)
        self.operator = stack.enter_context(create("mqtt", "operator", operator))

    def start(self, name: str, **sides: object) -> Forked:
        """Start a gateway to the operators' broker."""
        file = self._folder / f"{name}.json"
        file.write_text(json.dumps({"id": name, "mqtt": {"host": "127.0.0.1", "port": self.broker.port}, **sides}))
        process = Forked(__name__, str(file))
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.kill)
        return process

    def client(self, name: str) -> Transport:
        """Return a client of the hub."""
        at_hub = ZenohSettings(run_dir=self._folder / name, connect=(self.endpoint,), client=True, lease_ms=500)
        return create("zenoh", name, at_hub)


class Hall(Gateways):
    """A robot at the hub; ``received``: numbers of the commands that it got."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__(folder, stack)
        self.number = 0
        self.sent: dict[int, float] = {}
        self.robot = stack.enter_context(self.client("r0"))
        self.received: list[int] = []
        self.stops: list[float] = []
        self.robot.publish(CAPABILITIES.topic(ROBOT), b"{}", qos=QoS.DELIVERED, retain=True)
        self.robot.subscribe(DRIVE.topic(ROBOT), self._on_drive, direct=True)
        self.robot.subscribe(ESTOP.topic(ROBOT), lambda _stop: self.stops.append(time.monotonic()), direct=True)
        self.gateway = self.gate("gate-1")

    def gate(self, name: str) -> Forked:
        return self.start(name, hub={"connect": [self.endpoint]})

    def drives(self) -> bool:
        """Send a heartbeat and a command; True if the robot gets a command meanwhile."""
        before = len(self.received)
        self.number += 1
        self.sent[self.number] = time.monotonic()
        heartbeat = json.dumps({"t": int(time.time() * 1000)}).encode()
        self.robot.publish(ONLINE.topic(ROBOT), heartbeat, qos=QoS.DELIVERED, retain=True)
        command = json.dumps({"x": 0.5, "z": 0.0, "n": self.number}).encode()
        self.operator.publish(DRIVE.topic(ROBOT), command, qos=QoS.DELIVERED)
        return until(lambda: len(self.received) > before, 0.25)

    def is_stopped_at_once(self) -> None:
        stopped = time.monotonic()
        self.operator.publish(ESTOP.topic(ROBOT), b'{"stop": "0123456789abcdef"}', qos=QoS.DELIVERED, urgent=True)
        assert until(lambda: self.stops)
        assert self.stops[0] - stopped <= STOP_S

    def _on_drive(self, message: Message) -> None:
        if message.payload.strip():  # else a probe for cycles
            self.received.append(json.loads(message.payload)["n"])


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    with ExitStack() as stack:
        yield Hall(tmp_path, stack)


def test_a_second_one_does_not_start_and_takes_over_where_it_is_tried_again(hall: Hall) -> None:
    """As systemd does."""
    assert until(hall.drives), hall.gateway.printed
    second = hall.gate("gate-2")
    assert until(lambda: hall.drives() and second.poll() == 1)
    assert f"gateway gate-2 does not start: gate-1 carries {ROBOT}" in second.printed
    hall.gateway.kill()
    hall.gateway.wait(WAIT_S)
    hall.gate("gate-2")
    assert until(hall.drives)
    hall.is_stopped_at_once()
    again = hall.gate("gate-1")
    assert until(lambda: hall.drives() and again.poll() == 1)
    assert hall.received == sorted(set(hall.received)), "none came twice, or after a newer one"


def test_what_waited_for_a_gateway_that_stood_still_is_too_old(hall: Hall) -> None:
    assert until(hall.drives), hall.gateway.printed
    os.kill(hall.gateway.pid, signal.SIGSTOP)
    threads = Path(f"/proc/{hall.gateway.pid}/task").glob("*/stat")
    assert until(lambda states=[*threads]: {one.read_text().rpartition(")")[2].split()[0] for one in states} == {"T"})
    first, stood = hall.number + 1, time.monotonic()
    while time.monotonic() < stood + 2.0:
        hall.drives()
    old = {number for number in range(first, hall.number + 1) if time.monotonic() - hall.sent[number] > 1.0}
    os.kill(hall.gateway.pid, signal.SIGCONT)
    assert until(hall.drives)
    assert old
    assert not old & {*hall.received}
    hall.is_stopped_at_once()


LAMP = "pebble/robots/minilamp"
GRANT = {"shares": [ONLINE.metric], "commanded": {"goob": [DRIVE.metric]}}
_RUNS = itertools.count(7)  # the gateway's state has each that has begun, as long as this process


def test_a_board_is_driven_by_a_neighbour_until_a_person_does() -> None:
    with tempfile.TemporaryDirectory(prefix="pbl") as name, ExitStack() as stack:
        folder, received = Path(name), list[Message]()
        lan, near = Gateways(folder, stack), Broker(folder)
        stack.callback(near.kill)
        neighbours = {LAMP: {"lan": {"connect": [lan.endpoint]}, **GRANT}}
        gateway_ = lan.start("gate-1", boards={"host": "127.0.0.1", "port": near.port}, neighbours=neighbours)
        board = stack.enter_context(Robots(near.port, kinds=("minilamp",)))
        goob = One(folder / "goob", lan.client("goob-lan"), "goob", stack, listens={"minilamp": [ONLINE.metric]})
        lan.operator.subscribe(f"{LAMP}/outgoing/#", received.append, direct=True)

        def newest(metric: str) -> dict[str, object]:
            found = [one.payload for one in list(received) if one.topic == f"{LAMP}/outgoing/{metric}"]
            return json.loads(found[-1]) if found else {}

        def started() -> Robot:
            """A new start of a script of goob's."""
            run = next(_RUNS)
            robot = Robot(goob.config, MemoryTransport(f"script-{run}", goob.hub).open(), lambda _above: run)
            stack.callback(robot.close)
            assert until(lambda: robot.neighbour("minilamp").online)
            return robot

        def drives(robot: Robot, seconds: float) -> bool:
            """Let it drive the board for so long; whether its motors ran."""
            began = time.monotonic()
            while time.monotonic() < began + seconds:
                robot.neighbour("minilamp").drive(z=0.4)
                time.sleep(0.05)
            return any(at > began and any(motors) for at, motors in list(board.moves["minilamp"]))

        board.wait_online()
        assert until(lambda: all(map(newest, ("online", "capabilities", "neighbours")))), gateway_.printed
        robot = started()
        lamp = robot.neighbour("minilamp")
        assert until(lambda: lamp.latest(ONLINE) is not None), "goob receives what it shares"
        assert until(lambda: drives(robot, 0.3))
        assert until(lambda: newest("neighbours")["driven_by"] == "goob")
        lan.operator.publish(DRIVE.topic(LAMP), b'{"x": 0, "z": 0}', qos=QoS.DELIVERED)
        assert until(lambda: lamp.why_refused)
        assert until(lambda: not board.moving("minilamp"), SOON_S)
        assert not drives(robot, 0.5), "a person has ended its run"
        time.sleep(2.0)  # which holds for this long
        again = started()
        assert until(lambda: drives(again, 0.3)), "a new start drives"
        lan.operator.publish(ESTOP.topic(LAMP), b'{"stop": "ssssssssssssssss", "by": "ann"}', qos=QoS.DELIVERED)
        assert until(lambda: newest("estop/mcu").get("latched")), "the operators' stop"
        assert not drives(again, 0.5)
