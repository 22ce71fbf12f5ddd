"""A computed camera and microphone, for robots that have none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from pebble.config.media import CameraCapture, Microphone
from pebble.errors import DeviceError
from pebble.media.scene import Scene
from pebble.media.speech import Speech
from pebble.services.av_daemon.alsa import CHUNK_S
from pebble.services.av_daemon.source import Bytes, Capture
from pebble.transports.frames import FrameInfo

_BEHIND = 10  # chunks of sound that are made up for after a delay


class Pacer:
    """Waits for turn ``n``, which is due at ``start + n / rate``, however long the turns before it took.

    A caller that is more than ``behind`` turns late skips to the present one. :meth:`interrupt` ends the wait.
    """

    def __init__(self, rate: float, *, behind: int = 0, start: float, clock: Callable[[], float] = time.monotonic):
        self._rate, self._behind, self._start, self._clock = rate, behind, start, clock
        self._turn = self._now()
        self.skipped = 0  # turns left out before the present one
        self._interrupted = threading.Event()

    def next(self) -> int:
        """Wait for the next turn; returns its number, counted from ``start``."""
        self._turn += 1
        late = self._now() - self._turn
        self.skipped = late if late > self._behind else 0
        self._turn += self.skipped
        self._interrupted.wait(max(0.0, self.due(self._turn) - self._clock()))
        return self._turn

    def turn(self) -> int:
        """The same; raises DeviceError if the wait was interrupted."""
        turn = self.next()
        if self.interrupted:
            raise DeviceError("interrupted")
        return turn

    def due(self, turn: int) -> float:
        return self._start + turn / self._rate

    def interrupt(self) -> None:
        self._interrupted.set()

    @property
    def interrupted(self) -> bool:
        return self._interrupted.is_set()

    def _now(self) -> int:
        """The latest turn that is due."""
        return int((self._clock() - self._start) * self._rate)


class SyntheticCamera:
    """The scene, frame ``n`` at ``start + n / fps``: its counter goes on without readers."""

    def __init__(self, video: CameraCapture, start: float) -> None:
        self._scene = Scene(video.width, video.height)
        self._shape = (video.height, video.width, 3)
        self._size = video.height * video.width * 3
        self._info = FrameInfo(format="bgr24", width=video.width, height=video.height, stride=3 * video.width)
        self._pacer = Pacer(video.fps, start=start)

    def grab(self) -> Capture:
        number = self._pacer.turn()

        def draw(target: Bytes) -> None:
            self._scene.render(number, target.reshape(self._shape))

        return Capture(self._info, self._size, draw=draw, skipped=self._pacer.skipped)

    def close(self) -> None:
        """Nothing is open."""

    def interrupt(self) -> None:
        self._pacer.interrupt()


class SyntheticMicrophone:
    """Speech in chunks of 20 ms; sample ``n`` was recorded at ``start + n / rate``."""

    def __init__(self, audio: Microphone, start: float) -> None:
        self._speech = Speech(audio.rate, audio.channels)
        self._count = round(audio.rate * CHUNK_S)
        self._info = FrameInfo(format="s16le", rate=audio.rate, channels=audio.channels)
        self._pacer = Pacer(audio.rate / self._count, behind=_BEHIND, start=start)

    def grab(self) -> Capture:
        turn = self._pacer.turn()  # a chunk is complete when the next one begins
        samples = self._speech.samples((turn - 1) * self._count, self._count)
        at_ns = int(self._pacer.due(turn) * 1e9)
        return Capture(self._info, samples.nbytes, samples, at_ns=at_ns, skipped=self._pacer.skipped)

    def close(self) -> None:
        """Nothing is open."""

    def interrupt(self) -> None:
        self._pacer.interrupt()
