"""Measures how long an operator waits for the first picture: the camera at rest, and while others already watch."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

from pebble.bench.robot_subscriber import RobotSubscriber
from pebble.client.media_receiver import MediaReceiver
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.media.decode import Decoded
from pebble.rig.robot import BASE, MEDIA, Robot, one_robot
from pebble.transports import MqttSettings, Transport, create

ENCODINGS = ALL_VIDEO
AT_REST, RUNNING = STATES = ("at rest", "running")
_CAMERA = "camera_publisher"  # runs while it is requested
_UP_S, _REST_S, _PICTURE_S = 20.0, 10.0, 15.0
_POLL_S = 0.02  # how often the operator looks whether a key frame is missing


class _Operator(MediaReceiver):
    """An operator who waits for the first picture in one encoding."""

    def __init__(self, transport: Transport, encoding: str) -> None:
        self._encoding, self._first_ns = encoding, 0
        self._shown = threading.Event()
        super().__init__(transport, BASE)

    def on_picture(self, picture: Decoded) -> None:
        if picture.encoding == self._encoding and not self._shown.is_set():
            self._first_ns = time.monotonic_ns()
            self._shown.set()

    def wait_ms(self) -> float:
        """Milliseconds from the request to the first picture. Raises PebbleError if none comes."""
        self.wait_for_capabilities(_UP_S)
        began_ns = time.monotonic_ns()
        self.request(self._encoding, sound=False)
        while not self._shown.wait(_POLL_S):
            self.poll()
            if time.monotonic_ns() - began_ns > 1e9 * _PICTURE_S:
                raise PebbleError(f"no picture as {self._encoding} within {_PICTURE_S:.0f} s")
        return (self._first_ns - began_ns) / 1e6


def measure(kind: str) -> dict[tuple[str, str], float]:
    """Milliseconds by encoding and state of the camera, of a fresh robot. Raises PebbleError."""
    waits: dict[tuple[str, str], float] = {}
    with one_robot(kind, services=MEDIA) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        robot.launch()
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", _UP_S)
        for encoding in ENCODINGS:
            robot.expect(lambda: _CAMERA not in robot.processes(), "the camera does not rest", _REST_S)
            with _operator(robot, encoding) as first, _operator(robot, encoding) as second:
                waits[encoding, AT_REST], waits[encoding, RUNNING] = first.wait_ms(), second.wait_ms()
    return waits


@contextmanager
def _operator(robot: Robot, encoding: str) -> Iterator[_Operator]:
    """Connected beforehand, as an operator who has the robot's page open."""
    settings = MqttSettings(host="127.0.0.1", port=robot.remote_port)
    with (
        create("mqtt", f"operator-{time.monotonic_ns()}", settings) as transport,
        closing(_Operator(transport, encoding)) as operator,
    ):
        yield operator
