"""A gateway that is killed and hangs, while a robot is driven and stopped; it, hub and broker are processes."""

from __future__ import annotations

import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ONLINE
from pebble.transports import Message, MqttSettings, QoS, ZenohSettings, create
from tests.support import Broker, free_port, further, until
from tests.transports.forked import Forked

pytestmark = pytest.mark.alone
FAULT_S, SECOND_S = 2.0, 10.0
BACK_S, STOP_S = 6.0, 1.0
COMMANDS_HZ, HEARTBEAT_EACH = 40, 10  # of the commands each tenth comes with a heartbeat
ROBOT = "pebble/robots/r0"


class Hall:
    """A robot at a hub, which an operator at a broker drives all the time; ``received``: numbers of its commands."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.broker = Broker(folder, "max_queued_messages 20000")
        stack.callback(self.broker.kill)
        self.hub_port = free_port()
        endpoint = (f"tcp/127.0.0.1:{self.hub_port}",)
        settings = ZenohSettings(run_dir=folder / "hub", listen=endpoint)
        hub = Forked("pebble.extensions.lab.rig.hub", [msgspec.json.encode(settings, enc_hook=str).decode()])
        stack.callback(hub.kill)
        at_hub = ZenohSettings(run_dir=folder / "r0", connect=endpoint, client=True)
        self.robot = stack.enter_context(create("zenoh", "r0", at_hub))
        self.sent: dict[int, float] = {}
        self.received: list[tuple[int, float]] = []
        self.stops: list[float] = []
        self.robot.publish(CAPABILITIES.topic(ROBOT), b"{}", qos=QoS.DELIVERED, retain=True)
        self.robot.subscribe(DRIVE.topic(ROBOT), self._on_drive, direct=True)
        self.robot.subscribe(ESTOP.topic(ROBOT), lambda _stop: self.stops.append(time.monotonic()), direct=True)
        operator = MqttSettings(host="127.0.0.1", port=self.broker.port)
        self.operator = stack.enter_context(create("mqtt", "operator", operator))
        self._ending = threading.Event()
        self.gateway = self.start("gate-1")
        thread = threading.Thread(target=self._drive, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._ending.set)
        self.wait_until_carried()

    def start(self, name: str) -> Forked:
        """Start a gateway."""
        file = self._folder / f"{name}.json"
        sides = {
            "hub": {"connect": [f"tcp/127.0.0.1:{self.hub_port}"]},
            "mqtt": {"host": "127.0.0.1", "port": self.broker.port},
        }
        file.write_text(json.dumps({"id": name, **sides}))
        process = Forked("tests.ext.fleet.gateway_process", str(file))
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.kill)
        return process

    def driven(self, since: float) -> bool:
        """Return True if the robot has had a command that was sent after ``since``."""
        return bool(self.received) and self.sent[self.received[-1][0]] > since

    def wait_until_carried(self) -> None:
        """Wait until the robot is driven without a break: after a start, or a fault."""
        now = time.monotonic()
        assert until(lambda: self.driven(now + 2.5), 60), len(self.received)

    def wrong(self) -> int:
        """Count the commands that came twice, after a newer one, or older than 1 s."""
        late = sum(at - self.sent[number] > 1 for number, at in self.received)
        return late + sum(later[0] <= earlier[0] for earlier, later in itertools.pairwise(self.received))

    def _drive(self) -> None:
        """Send commands and heartbeats by one schedule: what is late is late for all."""
        due = time.monotonic()
        for number in itertools.count(1):
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return
            due += 1 / COMMANDS_HZ
            command = json.dumps({"x": 0.5, "z": 0.0, "n": number}).encode()
            self.sent[number] = time.monotonic()
            self.operator.publish(DRIVE.topic(ROBOT), command, qos=QoS.DELIVERED)
            if number % HEARTBEAT_EACH == 0:
                heartbeat = json.dumps({"t": int(time.time() * 1000)}).encode()
                self.robot.publish(ONLINE.topic(ROBOT), heartbeat, qos=QoS.DELIVERED, retain=True)

    def _on_drive(self, message: Message) -> None:
        if message.payload.strip():  # else a probe for cycles
            self.received.append((json.loads(message.payload)["n"], time.monotonic()))


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    with ExitStack() as stack:
        yield Hall(tmp_path, stack)


def kill(hall: Hall) -> None:
    hall.gateway.kill()
    hall.gateway.wait(10)


def start_again(hall: Hall) -> None:
    hall.gateway = hall.start("gate-1")


FAULTS: dict[str, tuple[Callable[[Hall], None], Callable[[Hall], None]]] = {
    "kill": (kill, start_again),
    "hang": (
        lambda hall: os.kill(hall.gateway.pid, signal.SIGSTOP),
        lambda hall: os.kill(hall.gateway.pid, signal.SIGCONT),
    ),
}


@pytest.mark.parametrize("fault", ["kill", further("hang")])
def test_after_a_fault_its_robot_is_driven_and_stopped_again(hall: Hall, fault: str) -> None:
    begin, end = FAULTS[fault]
    begin(hall)
    time.sleep(FAULT_S)
    end(hall)
    mended = time.monotonic()
    assert until(lambda: hall.driven(mended), 30)
    assert time.monotonic() - mended <= BACK_S
    stopped = time.monotonic()
    hall.operator.publish(ESTOP.topic(ROBOT), b'{"stop": "0123456789abcdef"}', qos=QoS.DELIVERED, urgent=True)
    assert until(lambda: hall.stops, 10)
    assert hall.stops[0] - stopped <= STOP_S
    assert hall.wrong() == 0


def test_a_second_one_does_not_start_and_takes_over_where_it_is_tried_again(hall: Hall) -> None:
    """As systemd does."""
    second = hall.start("gate-2")
    assert second.wait(SECOND_S) == 1
    assert f"gateway gate-2 does not start: gate-1 carries {ROBOT}" in second.printed
    assert hall.wrong() == 0
    kill(hall)
    began = time.monotonic()
    hall.start("gate-2")
    assert until(lambda: hall.driven(began), SECOND_S)
    assert hall.start("gate-1").wait(SECOND_S) == 1
    assert hall.wrong() == 0
