"""The demo's robots on a real mosquitto: idle, then driven and watched, recorded by ``pebble record``."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from pebble.client.media_receiver import MediaReceiver
from pebble.errors import PebbleError
from pebble.rig.operator import Operator
from pebble.rig.programs import Program, end_all
from pebble.rig.testbed import ROBOTS, Testbed
from pebble.transports import MqttSettings, create

VIDEO, AUDIO = "json", "pcm"  # the encodings of the paper's robots
_READY_S = 30.0
_POLL_S = 0.1
_LAST_S = 0.5  # until what was published last is recorded
_END_S = 10.0  # for the recorder to finish its files


def record(folder: Path, idle_s: float, session_s: float) -> None:
    """Record all robots into ``folder``: idle for ``idle_s``, then used for ``session_s``. Raises PebbleError."""
    with Testbed(threading.Event()) as testbed:
        testbed.start_brokers()
        with _recorder(folder, testbed.broker_port), closing(_Session(testbed.broker_port)) as session:
            testbed.start_robots()
            session.operator.wait_until_ready(len(ROBOTS), _READY_S, testbed.unexpected_exits)
            time.sleep(idle_s)
            session.run(session_s)
            if problems := testbed.unexpected_exits():
                raise PebbleError("; ".join(problems))
            time.sleep(_LAST_S)
        testbed.keep = False


@contextmanager
def _recorder(folder: Path, port: int) -> Iterator[None]:
    folder.mkdir()
    command = [sys.executable, "-m", "pebble.cli", "record", "--url", f"mqtt://127.0.0.1:{port}", "--into"]
    recorder = Program("pebble record", [*command, str(folder / "recordings")], folder / "record.log")
    try:
        recorder.wait_until(lambda: b"Recording" in recorder.log.read_bytes(), _READY_S)  # it is connected
        yield
        if recorder.ended:
            raise PebbleError(f"pebble record ended: {recorder.tail()}")
    finally:
        end_all([recorder], _END_S)


class _Session:
    """The demo's operator, and a viewer of all pictures and sound."""

    def __init__(self, port: int) -> None:
        self.operator = Operator(port, "pebble-bench-operator")
        self.operator.connect()
        self._viewer = create("mqtt", "pebble-bench-viewer", MqttSettings(host="127.0.0.1", port=port))
        self._watching = ExitStack()

    def run(self, seconds: float) -> None:
        """Drive all robots while their pictures and sound arrive, of those that have them. Raises PebbleError."""
        self._viewer.open()
        robots = self.operator.discovery.all_robots()
        receivers = [self._watch(robot.base) for robot in robots if robot.offers("video")]
        self._wait_for_media(receivers)
        self.operator.begin()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(_POLL_S)
            for receiver in receivers:
                receiver.poll()
            self.operator.completed.clear()  # nothing is assessed here
        self._watching.close()

    def _wait_for_media(self, receivers: Sequence[MediaReceiver]) -> None:
        end = time.monotonic() + _READY_S
        while missing := [one.name for one in receivers if not one.encoding.keys() >= {"video", "audio"}]:
            if time.monotonic() > end:
                raise PebbleError(f"no pictures or no sound came from {', '.join(missing)}")
            time.sleep(_POLL_S)
            for receiver in receivers:
                receiver.poll()

    def close(self) -> None:
        self._watching.close()
        self.operator.close()
        self._viewer.close()

    def _watch(self, base: str) -> MediaReceiver:
        receiver = self._watching.enter_context(closing(MediaReceiver(self._viewer, base)))
        receiver.wait_for_capabilities(_READY_S)
        receiver.viewer.request("video", VIDEO)
        receiver.viewer.request("audio", AUDIO)
        return receiver
