"""The view of a robot's camera in a simulated world, whose program shares the robots' poses."""

from __future__ import annotations

import time
from collections.abc import Mapping

import msgspec

from pebble.errors import NotRunningError
from pebble.extensions.lab.simulation.world.pose_page import PoseReader, page_path
from pebble.extensions.lab.simulation.world.poses import Track
from pebble.extensions.lab.simulation.world.renderer import Renderer
from pebble.extensions.lab.simulation.world.surfaces import Image
from pebble.extensions.lab.simulation.world.world_file import open_world, split_device

STALE_S = 1.0  # a world that has written nothing for so long does not run


class RobotView:
    """The camera view of the robot that ``device`` (``world.json#goob``) names.

    Raises DeviceError if the file or the robot is wrong, NotRunningError while the world does not run.
    """

    def __init__(self, device: str, width: int, height: int) -> None:
        self._path, self._robot = split_device(device)
        world = open_world(self._path, self._robot)
        self._latency_ns = round(world.camera.latency_ms * 1e6)
        self._renderer = Renderer(world, self._robot, width, height)
        self._tracks: Mapping[str, Track] = {}
        try:
            self._page = PoseReader(page_path(self._path))
        except (OSError, msgspec.DecodeError):
            raise self._not_running() from None
        self.look()

    def look(self) -> int:
        """Choose the moment of the next picture; return it in monotonic ns. Raises NotRunningError."""
        self._tracks = self._page.tracks()
        track = self._tracks.get(self._robot)
        if track is None or time.monotonic_ns() - track.newest.ns > STALE_S * 1e9:
            raise self._not_running()
        self._at_ns = track.newest.ns - self._latency_ns
        return self._at_ns

    def draw(self, out: Image) -> None:
        """Draw the picture of the moment that ``look`` chose into an array of shape (height, width, 3)."""
        self._renderer.render(self._tracks, self._at_ns, out)

    def _not_running(self) -> NotRunningError:
        return NotRunningError(f"the world does not run, start it: pebble sim world {self._path}")
