"""The camera of a robot in a simulated world, whose program shares where the robots are."""

from __future__ import annotations

import threading
import time
from importlib import import_module
from typing import TYPE_CHECKING

from pebble.config.media import CameraCapture
from pebble.errors import DeviceError, NotRunningError
from pebble.services.av_daemon.source import Bytes, Capture
from pebble.services.av_daemon.synthetic import Pacer
from pebble.transports.frames import FrameInfo

if TYPE_CHECKING:
    from pebble.simulation.world.robot_view import RobotView

_WAIT_S = 10.0  # for a world that is not running yet, while the camera is opened
_SILENCE_S = 3.0  # for one that is running no longer
_POLL_S = 0.1
_VIEW = "pebble.simulation.world.robot_view"  # loaded by the robots that have one


class WorldCamera:
    """Pictures of what is seen from the robot that ``device`` (``world.json#goob``) names.

    ``at_ns`` is when the robots were where the picture shows them. A world that is not running is waited for; one that
    is started again is seen again.
    """

    def __init__(self, video: CameraCapture, start: float) -> None:
        self._video = video
        self._shape = (video.height, video.width, 3)
        self._size = video.height * video.width * 3
        self._info = FrameInfo(format="bgr24", width=video.width, height=video.height, stride=3 * video.width)
        self._interrupted = threading.Event()
        self._view = self._wait_for_view(_WAIT_S)
        self._pacer = Pacer(video.fps, start=start)

    def grab(self) -> Capture:
        self._pacer.turn()
        try:
            at_ns = self._view.look()
        except NotRunningError:
            self._view = self._wait_for_view(_SILENCE_S)
            at_ns = self._view.look()

        def draw(target: Bytes) -> None:
            self._view.draw(target.reshape(self._shape))

        return Capture(self._info, self._size, draw=draw, at_ns=at_ns, skipped=self._pacer.skipped)

    def close(self) -> None:
        """Nothing is open."""

    def interrupt(self) -> None:
        self._interrupted.set()
        self._pacer.interrupt()

    def _wait_for_view(self, seconds: float) -> RobotView:
        video, deadline = self._video, time.monotonic() + seconds
        while True:
            try:
                view: RobotView = import_module(_VIEW).RobotView(video.device, video.width, video.height)
                return view
            except NotRunningError:
                if time.monotonic() >= deadline:
                    raise
            if self._interrupted.wait(_POLL_S):
                raise DeviceError("interrupted")
