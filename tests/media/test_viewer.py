"""What somebody who watches changes about a robot, and what he leaves as it was."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from pebble.errors import PebbleError
from pebble.media.viewer import Viewer
from pebble.transports import QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

BASE = "pebble/robots/goob"
ASK, FLAG, CAMERA = (
    f"{BASE}/incoming/front-camera",
    f"{BASE}/incoming/flags/mqtt-video",
    f"{BASE}/outgoing/front-camera",
)
CAN = (
    b'{"t":1,"schema":"pebble-capabilities/v1","value":{"video":{"available":true,"controls":true,'
    b'"topic":"pebble/robots/goob/outgoing/front-camera","encodings":["json","h264"]}}}'
)


class Robot:
    """The robot's end, and everybody else's: says what it can do and hears what is asked of it."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.transport = MemoryTransport("robot", self.hub).open()
        self.asked: list[bytes] = []
        self.flags: list[bytes] = []
        self.transport.publish(f"{BASE}/outgoing/capabilities", CAN, qos=QoS.DELIVERED, retain=True)
        self.transport.subscribe(ASK, lambda message: self.asked.append(message.payload), direct=True)
        self.transport.subscribe(FLAG, lambda message: self.flags.append(message.payload), echo=False, direct=True)

    def say(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        self.transport.publish(topic, payload, qos=QoS.DELIVERED, retain=retain)


@pytest.fixture
def robot() -> Iterator[Robot]:
    robot = Robot()
    yield robot
    robot.transport.close()


@pytest.fixture
def viewer(robot: Robot) -> Iterator[Viewer]:
    transport = MemoryTransport("viewer", robot.hub).open()
    viewer = Viewer(transport, BASE, lambda _medium, _payload: None)
    viewer.wait_known(5)
    yield viewer
    transport.close()


def test_it_lifts_the_flag_asks_and_puts_both_back(robot: Robot, viewer: Viewer) -> None:
    viewer.ask("video", "h264")
    assert until(lambda: robot.asked == [b'{"enabled":true,"encoding":"h264"}'])
    assert robot.flags == [b'{"value":true}']
    viewer.end()
    assert until(lambda: robot.asked[-1] == b'{"enabled":false}')
    assert robot.flags == [b'{"value":true}', b'{"value":false}']


def test_a_flag_that_was_up_stays_up(robot: Robot, viewer: Viewer) -> None:
    robot.say(FLAG, b"true", retain=True)
    viewer.ask("video")
    viewer.end()
    assert until(lambda: robot.asked == [b'{"enabled":true}', b'{"enabled":false}'])
    assert robot.flags == []


def test_a_flag_that_somebody_lowers_stays_down(robot: Robot, viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.media.viewer._REPEAT_S", 0.0)
    viewer.ask("video")
    assert until(lambda: robot.flags == [b'{"value":true}'])
    robot.say(FLAG, b"false", retain=True)
    assert until(lambda: not viewer._flags[FLAG])
    viewer.keep_asking()
    viewer.end()
    assert until(lambda: robot.asked[-1] == b'{"enabled":false}')
    assert robot.flags == [b'{"value":true}']


def test_what_somebody_else_watches_is_neither_changed_nor_ended(robot: Robot, viewer: Viewer) -> None:
    robot.say(FLAG, b"true", retain=True)
    stop = False

    def show() -> bool:
        robot.say(CAMERA, b"a picture")
        return stop

    thread = threading.Thread(target=lambda: until(show, 10, step=0.02))
    thread.start()
    viewer.ask("video")
    viewer.want_keyframe("h264")
    viewer.end()
    stop = True
    thread.join(10)
    assert robot.asked == [b'{"enabled":true,"encoding":"h264","keyframe":true}']


def test_what_is_not_offered_is_refused_in_words(viewer: Viewer) -> None:
    with pytest.raises(PebbleError, match="offers no audio"):
        viewer.ask("audio")
    with pytest.raises(PebbleError, match="only as json, h264"):
        viewer.ask("video", "pbvd")


def test_another_thread_may_keep_asking_from_the_first_moment(robot: Robot, viewer: Viewer) -> None:
    asking = threading.Thread(target=viewer.ask, args=("video",))
    asking.start()
    while asking.is_alive():  # for the 0.4 s in which it looks whether pictures come anyway
        viewer.keep_asking()
    assert until(lambda: robot.asked == [b'{"enabled":true}'])
