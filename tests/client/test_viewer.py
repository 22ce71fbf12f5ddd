"""What a viewer changes about a robot, and what it leaves as it was."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from unittest.mock import MagicMock

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
CAN = (
    b'{"t":1,"schema":"pebble-capabilities/v1","value":{"video":{"available":true,"controls":true,'
    b'"topic":"pebble/robots/goob/outgoing/front-camera","encodings":["json","h264"]}}}'
)


class Robot:
    """The robot's end: publishes capabilities, flags and pictures, and records requests and flags."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.transport = MemoryTransport("robot", self.hub).open()
        self.requests: list[bytes] = []
        self.flags: list[bytes] = []
        self.transport.publish(f"{BASE}/outgoing/capabilities", CAN, qos=QoS.DELIVERED, retain=True)
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
    viewer = Viewer(transport, BASE, lambda _medium, _payload: None)
    viewer.wait_for_capabilities(5)
    return viewer


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
    robot = Robot()
    foreign = b'"controls":true,"command_topic":"pebble/robots/fred/incoming/front-camera"'
    capabilities = CAN.replace(b'"controls":true', foreign)
    robot.transport.publish(f"{BASE}/outgoing/capabilities", capabilities, qos=QoS.DELIVERED, retain=True)
    with MemoryTransport("viewer", robot.hub) as transport:
        viewer = Viewer(transport, BASE, lambda _medium, _payload: None)
        viewer.wait_for_capabilities(5)
        assert viewer.topic(VIDEO_CONTROL) == REQUEST


def test_without_a_receiver_it_receives_no_media_but_learns_of_them(
    robot: Robot, transport: MemoryTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    subscribe = MagicMock(wraps=transport.subscribe)
    monkeypatch.setattr(transport, "subscribe", subscribe)
    viewer = Viewer(transport, BASE, None)
    viewer.wait_for_capabilities(5)
    viewer.note_received("video")
    viewer.request("video")  # another viewer's pictures arrive already
    assert [call.args[0] for call in subscribe.call_args_list] == [f"{BASE}/outgoing/capabilities", FLAG]
    viewer.close()
    assert robot.requests == []
