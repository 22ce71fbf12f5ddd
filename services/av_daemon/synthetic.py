"""A computed camera and microphone, for robots that have none."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.speech import Speech
from pebble.services.av_daemon.alsa import CHUNK_S
from pebble.services.av_daemon.config import CameraCapture, Microphone
from pebble.services.av_daemon.source import Bytes, Capture

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.world.robot_view import RobotView

_BEHIND = 10  # chunks of sound that are made up for after a delay


class Pacer:
    """A steady pace: turn ``n`` is due at ``start + n / rate``, however long earlier turns took.

    A caller that is more than ``behind`` turns late skips to the present one. :meth:`interrupt` ends the wait.
    """

    def __init__(self, rate: float, *, behind: int = 0, start: float, clock: Callable[[], float] = time.monotonic):
        self._rate, self._behind, self._start, self._clock = rate, behind, start, clock
        self._turn = self._now()
        self.skipped = 0  # turns left out before the present one
        self._interrupted = threading.Event()

    def next(self) -> int:
        """Wait for the next turn; return its number, counted from ``start``. Raises DeviceError if interrupted."""
        self._turn += 1
        late = self._now() - self._turn
        self.skipped = late if late > self._behind else 0
        self._turn += self.skipped
        if self._interrupted.wait(max(0.0, self.due(self._turn) - self._clock())):
            raise DeviceError("interrupted")
        return self._turn

    def due(self, turn: int) -> float:
        return self._start + turn / self._rate

    def interrupt(self) -> None:
        self._interrupted.set()

    def _now(self) -> int:
        """Return the newest turn that is due."""
        return int((self._clock() - self._start) * self._rate)


class ComputedDevice:
    """A computed camera or microphone, which has nothing to open or close."""

    _pacer: Pacer

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def interrupt(self) -> None:
        self._pacer.interrupt()


class ComputedCamera(ComputedDevice, ABC):
    """A camera that draws a picture at each turn of a :class:`Pacer`, which also counts while there are no readers."""

    def __init__(self, video: CameraCapture, start: float) -> None:
        self._shape = (video.height, video.width, 3)
        self._info = FrameInfo(format="bgr24", width=video.width, height=video.height, stride=3 * video.width)
        self._pacer = Pacer(video.fps, start=start)

    @abstractmethod
    def look(self, turn: int) -> int:
        """Choose the picture to draw; return its moment in ns, or 0 for now."""

    @abstractmethod
    def draw(self, picture: Bytes) -> None:
        """Draw the picture that :meth:`look` has chosen into an array of shape (height, width, 3)."""

    def grab(self) -> Capture:
        at_ns = self.look(self._pacer.next())  # chooses the picture that `draw` draws, if there is a reader
        return Capture(
            self._info,
            self._info.stride * self._info.height,
            draw=lambda target: self.draw(target.reshape(self._shape)),
            at_ns=at_ns,
            skipped=self._pacer.skipped,
        )


class SyntheticCamera(ComputedCamera):
    """A camera that shows a computed scene: frame ``n`` at ``start + n / fps``."""

    def __init__(self, video: CameraCapture, start: float) -> None:
        super().__init__(video, start)
        self._scene = Scene(video.width, video.height)
        self._turn = 0

    def look(self, turn: int) -> int:
        self._turn = turn
        return 0

    def draw(self, picture: Bytes) -> None:
        self._scene.render(self._turn, picture)


class WorldCamera(ComputedCamera):
    """A camera on the robot that ``device`` (``world.json#goob``) names, in a world whose program shares poses.

    The moment of a picture is the time of the poses that it shows. Raises NotRunningError while the world does not run.
    """

    def __init__(self, video: CameraCapture, start: float) -> None:
        super().__init__(video, start)
        view = import_module("pebble.extensions.lab.simulation.world.robot_view")  # only who needs it pays for it
        self._view: RobotView = view.RobotView(video.device, video.width, video.height)

    def look(self, _turn: int) -> int:
        return self._view.look()

    def draw(self, picture: Bytes) -> None:
        self._view.draw(picture)


class SyntheticMicrophone(ComputedDevice):
    """A microphone with speech in pieces of 20 ms; sample ``n`` was recorded at ``start + n / rate``."""

    def __init__(self, audio: Microphone, start: float) -> None:
        self._speech = Speech(audio.rate, audio.channels)
        self._count = round(audio.rate * CHUNK_S)
        self._info = FrameInfo(format="s16le", rate=audio.rate, channels=audio.channels)
        self._pacer = Pacer(audio.rate / self._count, behind=_BEHIND, start=start)

    def grab(self) -> Capture:
        turn = self._pacer.next()  # a chunk is complete when the next one begins
        samples = self._speech.samples((turn - 1) * self._count, self._count)
        at_ns = int(self._pacer.due(turn) * 1e9)
        return Capture(self._info, samples.nbytes, samples, at_ns=at_ns, skipped=self._pacer.skipped)
