"""A camera and a microphone made of numbers: for robots that have none."""

from __future__ import annotations

from pebble.config.later import CameraCapture, Microphone
from pebble.errors import LinkError
from pebble.media.scene import Scene
from pebble.media.speech import Speech
from pebble.services.av_daemon.alsa import CHUNK_S
from pebble.services.av_daemon.pacer import Pacer
from pebble.services.av_daemon.source import Bytes, Capture
from pebble.transports.frames import FrameInfo

_BEHIND = 10  # chunks of sound that are made up for after standing still


class SyntheticCamera:
    """The scene, frame ``n`` at ``start + n / fps``: its counter goes on while nobody looks."""

    def __init__(self, video: CameraCapture, start: float) -> None:
        self._scene = Scene(video.width, video.height)
        self._shape = (video.height, video.width, 3)
        self._size = video.height * video.width * 3
        self._info = FrameInfo(format="bgr24", width=video.width, height=video.height, stride=3 * video.width)
        self._pacer = Pacer(video.fps, start=start)

    def grab(self) -> Capture:
        number = _turn(self._pacer)

        def draw(target: Bytes) -> None:
            self._scene.render(number, target.reshape(self._shape))

        return Capture(self._info, self._size, draw=draw, skipped=self._pacer.skipped)

    def close(self) -> None:
        """Nothing is open."""

    def interrupt(self) -> None:
        self._pacer.interrupt()


class SyntheticMicrophone:
    """Speech in chunks of 20 ms; sample ``n`` was heard at ``start + n / rate``."""

    def __init__(self, audio: Microphone, start: float) -> None:
        self._speech = Speech(audio.rate, audio.channels)
        self._count = round(audio.rate * CHUNK_S)
        self._info = FrameInfo(format="s16le", rate=audio.rate, channels=audio.channels)
        self._pacer = Pacer(audio.rate / self._count, behind=_BEHIND, start=start)

    def grab(self) -> Capture:
        turn = _turn(self._pacer)  # a chunk is complete when the next one begins
        samples = self._speech.samples((turn - 1) * self._count, self._count)
        at_ns = int(self._pacer.due(turn) * 1e9)
        return Capture(self._info, samples.nbytes, samples, at_ns=at_ns, skipped=self._pacer.skipped)

    def close(self) -> None:
        """Nothing is open."""

    def interrupt(self) -> None:
        self._pacer.interrupt()


def _turn(pacer: Pacer) -> int:
    turn = pacer.next()
    if pacer.interrupted:
        raise LinkError("interrupted")
    return turn
