"""What a viewer changes about a robot, and what it leaves as it was."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from pebble.client.viewer import Viewer
from pebble.contract import VIDEO_CONTROL
from pebble.errors import PebbleError
from pebble.transports import QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

BASE = "pebble/robots/goob"
REQUEST, FLAG, CAMERA = (
    f"{BASE}/incoming/front-camera",
    f"{BASE}/incoming/flags/mqtt-video",
    f"{BASE}/outgoing/front-camera",
)
VIDEO = {"available": True, "controls": True, "topic": CAMERA, "encodings": ["json", "h264"]}
CAN = {"video": VIDEO}


class Robot:
    """The robot's end: publishes capabilities, flags and pictures, and records requests and flags."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.transport = MemoryTransport("robot", self.hub).open()
        self.requests: list[bytes] = []
        self.flags: list[bytes] = []
        self.transport.subscribe(REQUEST, lambda message: self.requests.append(message.payload), direct=True)
        self.transport.subscribe(FLAG, lambda message: self.flags.append(message.payload), echo=False, direct=True)

    def publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        self.transport.publish(topic, payload, qos=QoS.DELIVERED, retain=retain)


@pytest.fixture
def robot() -> Iterator[Robot]:
    robot = Robot()
    yield robot
    robot.transport.close()


@pytest.fixture
def transport(robot: Robot) -> Iterator[MemoryTransport]:
    with MemoryTransport("viewer", robot.hub) as one:
        yield one


@pytest.fixture
def viewer(transport: MemoryTransport) -> Viewer:
    return Viewer(transport, BASE, lambda _medium, _payload: None, CAN)


def test_it_raises_the_flag_and_requests_and_undoes_both(robot: Robot, viewer: Viewer) -> None:
    viewer.request("video", "h264")
    assert until(lambda: robot.requests == [b'{"enabled":true,"encoding":"h264"}'])
    assert robot.flags == [b'{"value":true}']
    viewer.close()
    assert until(lambda: robot.requests[-1:] == [b'{"enabled":false}'])
    assert robot.flags == [b'{"value":true}', b'{"value":false}']


def test_a_flag_that_was_up_stays_up(robot: Robot, viewer: Viewer) -> None:
    robot.publish(FLAG, b"true", retain=True)
    viewer.request("video")
    viewer.close()
    assert until(lambda: robot.requests == [b'{"enabled":true}', b'{"enabled":false}'])
    assert robot.flags == []


def test_a_flag_lowered_by_another_operator_stays_down(
    robot: Robot, viewer: Viewer, transport: MemoryTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pebble.client.viewer._REPEAT_S", 0.0)
    viewer.request("video")
    assert until(lambda: robot.flags == [b'{"value":true}'])
    seen: list[bytes] = []
    transport.subscribe(FLAG, lambda message: seen.append(message.payload), direct=True)  # after the viewer's
    robot.publish(FLAG, b"false", retain=True)
    assert until(lambda: seen[-1:] == [b"false"])
    viewer.repeat_requests()
    viewer.close()
    assert until(lambda: robot.requests[-1:] == [b'{"enabled":false}'])
    assert robot.flags == [b'{"value":true}']


def test_a_stream_that_another_operator_requested_is_neither_changed_nor_ended(robot: Robot, viewer: Viewer) -> None:
    robot.publish(FLAG, b"true", retain=True)
    stop = False

    def show() -> bool:
        robot.publish(CAMERA, b"a picture")
        return stop

    thread = threading.Thread(target=lambda: until(show, 10, step=0.02))
    thread.start()
    viewer.request("video")
    viewer.request_keyframe("h264")
    viewer.close()
    stop = True
    thread.join(10)
    assert robot.requests == [b'{"enabled":true,"encoding":"h264","keyframe":true}']


def test_requesting_what_is_not_offered_is_an_error(viewer: Viewer) -> None:
    with pytest.raises(PebbleError, match="offers no audio"):
        viewer.request("audio")
    with pytest.raises(PebbleError, match="only as json, h264"):
        viewer.request("video", "pbvd")


def test_another_thread_may_repeat_requests_from_the_first_moment(robot: Robot, viewer: Viewer) -> None:
    requesting = threading.Thread(target=viewer.request, args=("video",))
    requesting.start()
    while requesting.is_alive():  # for the 0.4 s in which it looks whether pictures come anyway
        viewer.repeat_requests()
    assert until(lambda: robot.requests == [b'{"enabled":true}'])


def test_with_an_encoding_as_well_a_flag_that_was_up_stays_up(robot: Robot, viewer: Viewer) -> None:
    robot.publish(FLAG, b"true", retain=True)
    viewer.request("video", "h264")
    viewer.close()
    assert until(lambda: robot.requests[-1:] == [b'{"enabled":false}'])
    assert robot.flags == []


def test_requests_go_to_no_other_robot() -> None:
    foreign = {"video": {**VIDEO, "command_topic": "pebble/robots/fred/incoming/front-camera"}}
    with MemoryTransport("viewer", MemoryHub()) as transport:
        assert Viewer(transport, BASE, lambda *_: None, foreign).topic(VIDEO_CONTROL) == REQUEST
