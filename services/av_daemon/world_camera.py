"""The camera of a robot in a simulated world, whose program shares where the robots are."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from pebble.config.media import CameraCapture
from pebble.errors import DeviceError, NotRunningError
from pebble.media.world.pose_page import PoseReader, page_path
from pebble.media.world.poses import Track
from pebble.media.world.renderer import Renderer
from pebble.media.world.scene import Image
from pebble.media.world.world_file import open_world, split_device
from pebble.services.av_daemon.source import Bytes, Capture
from pebble.services.av_daemon.synthetic import Pacer
from pebble.transports.frames import FrameInfo

_WAIT_S = 10.0  # for a world that is not running yet, while the camera is opened
_SILENCE_S = 3.0  # for one that is running no longer
_POLL_S = 0.1
STALE_S = 1.0  # a world that has written nothing for so long does not run


class RobotView:
    """What is seen now from the robot that ``device`` (``world.json#goob``) names.

    Raises DeviceError for a file or robot that is wrong, NotRunningError while the world does not run.
    """

    def __init__(self, device: str, width: int, height: int, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._path, self._robot = split_device(device)
        world = open_world(self._path, self._robot)
        self._clock_ns = clock_ns
        self._latency_ns = round(world.camera.latency_ms * 1e6)
        self._renderer = Renderer(world, self._robot, width, height)
        self._tracks: Mapping[str, Track] = {}
        try:
            self._page = PoseReader(page_path(self._path))
        except (OSError, ValueError):
            raise self._not_running() from None
        self.look()

    def look(self) -> int:
        """Choose the moment of the next picture; returns it, monotonic ns. Raises NotRunningError."""
        self._tracks = self._page.tracks()
        track = self._tracks.get(self._robot)
        if track is None or not self._page.is_valid or self._clock_ns() - track.newest.ns > STALE_S * 1e9:
            raise self._not_running()
        self._at_ns = track.newest.ns - self._latency_ns
        return self._at_ns

    def draw(self, out: Image) -> None:
        """Draw the picture of the moment that ``look`` returned, into an array of shape (height, width, 3)."""
        self._renderer.render(self._tracks, self._at_ns, out)

    def _not_running(self) -> NotRunningError:
        return NotRunningError(f"the world does not run, start it: pebble sim world {self._path}")


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
        deadline = time.monotonic() + seconds
        while True:
            try:
                return RobotView(self._video.device, self._video.width, self._video.height)
            except NotRunningError:
                if time.monotonic() >= deadline:
                    raise
            if self._interrupted.wait(_POLL_S):
                raise DeviceError("interrupted")
