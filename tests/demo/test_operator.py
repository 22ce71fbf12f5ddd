"""The scripted operator beside people at the operator page."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from pebble.contract import (
    AUTONOMY_COMMAND,
    AUTONOMY_FILES,
    AUTONOMY_STATUS,
    CAPABILITIES,
    CONTROL,
    CONTROL_STATE,
    DRIVE,
    ESTOP_STATE,
    ONLINE,
    codec,
)
from pebble.contract.payloads import (
    AutonomyFiles,
    AutonomyStatus,
    Capabilities,
    ControlState,
    Drive,
    EstopState,
    Heartbeat,
)
from pebble.demo.operator import TRAIL, Operator
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from tests.support import Broker, until

BASE = "pebble/robots/goob"
KEY = "0badf00d"
START_S = 5.0


class Robot:
    """Capabilities and heartbeats of a robot that drives, and every drive command that it receives.

    It gives control to the operator's first request.
    """

    def __init__(self, port: int) -> None:
        self.transport: Transport = create("mqtt", "goob", MqttSettings(host="127.0.0.1", port=port))
        self.transport.open()
        self.drives: list[tuple[float, Drive]] = []
        self.asked = False
        self.scripts: list[str | None] = []
        self.transport.subscribe(DRIVE.topic(BASE), self._receive)
        self.transport.subscribe(AUTONOMY_COMMAND.topic(BASE), self._receive_script)
        self.transport.subscribe(CONTROL.topic(BASE), self._receive_request)
        value = {
            "drive": {"available": True, "topic": DRIVE.topic(BASE), "control": True},
            "estop": {"available": True, "owners": ["m"]},
            "autonomy": {"available": True},
        }
        payload = codec.encode(CAPABILITIES, Capabilities(t=1, value=value))
        self.transport.publish(CAPABILITIES.topic(BASE), payload, retain=True, qos=QoS.DELIVERED)
        files = codec.encode(AUTONOMY_FILES, AutonomyFiles(files=[{"file": TRAIL}], timestamp=1))
        self.transport.publish(AUTONOMY_FILES.topic(BASE), files, retain=True, qos=QoS.DELIVERED)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send_heartbeats, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self.transport.close()

    def driven_since(self, at: float) -> bool:
        return any(received > at for received, _ in list(self.drives))

    def give_control(self, holder: str, by: str) -> None:
        state = ControlState(id=holder, by=by, key=KEY[: len(holder)])
        topic = CONTROL_STATE.topic(BASE, owner="m")
        self.transport.publish(topic, codec.encode(CONTROL_STATE, state), retain=True, qos=QoS.DELIVERED)

    def show_script(self) -> None:
        status = codec.encode(AUTONOMY_STATUS, AutonomyStatus(running=True, timestamp=1, file=self.scripts[-1] or ""))
        self.transport.publish(AUTONOMY_STATUS.topic(BASE), status, qos=QoS.DELIVERED)

    def show_stop(self, *, by: str, latched: bool = True) -> None:
        state = EstopState(
            latched=latched, boot="b", count=1, recent=[], by=by, why="", since=1, reset_refused=None, persisted=None
        )
        topic = ESTOP_STATE.topic(BASE, owner="m")
        self.transport.publish(topic, codec.encode(ESTOP_STATE, state), retain=True, qos=QoS.DELIVERED)

    def _send_heartbeats(self) -> None:
        while not self._ended.wait(0.1):
            payload = codec.encode(ONLINE, Heartbeat(t=int(1000 * time.time())))
            self.transport.publish(ONLINE.topic(BASE), payload)

    def _receive_script(self, message: Message) -> None:
        self.scripts.append(codec.decode(AUTONOMY_COMMAND, message.payload).file)

    def _receive_request(self, message: Message) -> None:
        request = codec.decode(CONTROL, message.payload)
        if request.want == "hold" and not self.asked:
            self.give_control(request.id, request.by)
        self.asked = True

    def _receive(self, message: Message) -> None:
        self.drives.append((time.monotonic(), codec.decode(DRIVE, message.payload)))


@pytest.fixture
def robot(broker: Broker) -> Iterator[Robot]:
    running = Robot(broker.port)
    yield running
    running.close()


@pytest.fixture
def operator(broker: Broker, robot: Robot) -> Iterator[Operator]:
    running = Operator(broker.port)
    running.connect()
    assert until(lambda: running.not_ready(["goob"]) == [], START_S)
    yield running
    running.close()


def test_a_robot_that_a_person_has_taken_is_left_alone_until_the_step_after(robot: Robot, operator: Operator) -> None:
    operator.begin()
    assert until(lambda: robot.driven_since(0.0))
    assert {drive.key for _, drive in robot.drives} == {KEY}
    robot.give_control("3f2a91c0", "anna")
    assert until(lambda: operator.activity.endswith("; goob is driven by anna"))
    taken = time.monotonic()
    assert not until(lambda: robot.driven_since(taken + 0.1), 1.0)
    robot.give_control("", "")
    assert until(lambda: "goob" not in operator.activity, START_S)
    assert until(lambda: robot.driven_since(taken + 0.1), START_S)
    assert operator.visitors.left_alone == {"goob"}
    assert [one for one in operator.completed if one.ended > taken > one.began] == []


def test_a_persons_stop_is_left_to_the_person(robot: Robot, operator: Operator) -> None:
    robot.show_stop(by="anna")
    assert until(lambda: operator.activity.endswith("; goob is stopped by anna"))
    operator.begin()
    assert not until(lambda: robot.drives, 1.0)
    robot.show_stop(by="anna", latched=False)
    assert until(lambda: robot.drives, START_S)


def test_a_robot_that_another_program_drives_is_left_alone_as_well(
    broker: Broker, robot: Robot, operator: Operator
) -> None:
    operator.begin()
    assert until(lambda: robot.driven_since(0.0))
    with create("mqtt", "visitor", MqttSettings(host="127.0.0.1", port=broker.port)) as visitor:
        visitor.publish(DRIVE.topic(BASE), b'{"x": 0, "z": 0.3}', qos=QoS.DELIVERED)
    assert until(lambda: operator.activity.endswith("; goob is driven by another program"))
    taken = time.monotonic()
    assert until(lambda: operator.visitors.left_alone == {"goob"})
    assert until(lambda: robot.driven_since(taken + 0.1), 2 * START_S)
    assert [one for one in operator.completed if one.ended > taken > one.began] == []


def test_a_robot_with_scripts_draws_its_trail_from_the_first_drive_on(robot: Robot, operator: Operator) -> None:
    operator.begin("yours")
    assert until(lambda: robot.driven_since(0.0))
    assert until(lambda: robot.scripts == [TRAIL])  # two subscriptions: one may be a moment later
    robot.show_script()
    assert until(lambda: len(robot.scripts) > 1, 30.0)
    assert robot.scripts[:2] == [TRAIL, None], "it is ended before the emergency stop, which would make it fail"
