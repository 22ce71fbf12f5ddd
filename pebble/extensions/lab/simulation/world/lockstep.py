"""A simulated world on one virtual clock that the caller advances: real firmware, motion, contacts and cameras.

The same calls give the same bytes and pixels, in every run and however busy the machine is.
"""

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.motion import Pose
from pebble.extensions.lab.simulation.world.pose_page import PERIOD_S
from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track
from pebble.extensions.lab.simulation.world.renderer import Renderer
from pebble.extensions.lab.simulation.world.surfaces import Image
from pebble.extensions.lab.simulation.world.walls import Floor, motion_of
from pebble.extensions.lab.simulation.world.world_file import LONGEST_EXPOSURE_MS, LONGEST_LATENCY_MS, World

STEP_S: Final = 0.005  # one turn of the firmware's loop
WIDTH, HEIGHT, FPS = 640, 480, 15.0  # of pictures
_STEPS_PER_SAMPLE = round(PERIOD_S / STEP_S)
_SAMPLES = round((LONGEST_LATENCY_MS + LONGEST_EXPOSURE_MS) / 1000 / PERIOD_S) + 2


class Picture(NamedTuple):
    """A picture, BGR, (height, width, 3), and the time that it shows."""

    pixels: Image
    at: float


class LockstepWorld:
    """A world and its robots. ``now`` is the clock, in seconds since the start; pass it to what is tested.

    Example::

        world = LockstepWorld(read_world(path))
        goob = world.robots["goob"]
        while world.now() < 20:
            world.step()
            if (picture := goob.picture()) is not None:
                goob.drive(x=0.0, z=0.3)
    """

    def __init__(self, world: World) -> None:
        self._steps = 0
        floor, tracks = Floor(world), dict[str, Track]()
        self.robots = {name: LockstepRobot(world, name, floor, tracks) for name in world.robots}
        self._sample()

    def now(self) -> float:
        return self._steps * STEP_S

    def step(self) -> None:
        """Advance everything by ``STEP_S``."""
        self._steps += 1
        now = self.now()
        for robot in self.robots.values():
            robot.tick(now)
        if self._steps % _STEPS_PER_SAMPLE == 0:
            self._sample()

    def run(self, seconds: float) -> None:
        end = self.now() + seconds - STEP_S / 1000
        while self.now() < end:
            self.step()

    def _sample(self) -> None:
        for robot in self.robots.values():
            robot.sample()


class LockstepRobot:
    """A robot of a LockstepWorld, which calls ``tick`` and ``sample``: its serial line, camera and true state."""

    def __init__(self, world: World, name: str, floor: Floor, tracks: dict[str, Track]) -> None:
        """Put the robot at its start. ``tracks``: those of all robots, to which its own is added."""
        self.name = name
        self.motion = motion_of(world, name, floor)
        self.mcu = SimulatedMcu(world.robots[name].kind, 0.0, motion=self.motion)
        self._world = world
        self._renderer: Renderer | None = None  # made for the first picture: not every test has OpenCV to load
        self._now = 0.0
        self._output = b""  # of the MCU, not yet read
        self._samples: deque[Sample] = deque(maxlen=_SAMPLES)
        self._tracks = tracks
        tracks[name] = Track(self._samples)
        self._newest_picture = 0  # the number of the picture that was returned last

    @property
    def pose(self) -> RobotPose:
        self.mcu.body.advance()
        pose = self.motion.pose
        return RobotPose(pose.x_mm / 1000, pose.y_mm / 1000, pose.heading_rad)

    def place(self, x: float, y: float, heading: float) -> None:
        """Put the robot down at a place: metres and radians."""
        self.mcu.body.advance()
        self.motion.place(Pose(x * 1000, y * 1000, heading))

    # -- the serial line

    def write(self, data: bytes) -> None:
        """Send to the MCU, as the host does."""
        self._output += self.mcu.receive(data, self._now)

    def read(self) -> bytes:
        """Return what the MCU has sent since the last call."""
        output, self._output = self._output, b""
        return output

    def drive(self, x: float, z: float) -> None:
        """Send ``serial_mcu_bridge``'s line for a drive command: throttle ``z``, steering ``x``, + is right."""
        left, right = (min(1.0, max(-1.0, speed)) for speed in (z + x, z - x))
        self.write(b"M %.3f %.3f\n" % (round(left, 3) + 0.0, round(right, 3) + 0.0))  # + 0.0: no "-0.000"

    # -- the camera

    def picture(self) -> Picture | None:
        """Return the newest picture, unless it was returned before. It is rendered only when asked for."""
        number = int(self._now * FPS + 1e-6)  # rounding may leave it just below a whole number
        if number == self._newest_picture:
            return None
        self._newest_picture = number
        at = number / FPS - self._world.camera.latency_ms / 1000
        pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        if self._renderer is None:
            self._renderer = Renderer(self._world, self.name, WIDTH, HEIGHT)
        self._renderer.render(self._tracks, round(at * 1e9), pixels)
        return Picture(pixels, at)

    # -- for the world

    def tick(self, now: float) -> None:
        self._now = now
        self._output += self.mcu.tick(now)

    def sample(self) -> None:
        self._samples.append(Sample(round(self._now * 1e9), self.pose))
