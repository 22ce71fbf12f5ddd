"""Microphones, through ALSA's own recorder, ``arecord``."""

import shutil
import time

from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo
from pebble.services.av_daemon.capture_program import CaptureProgram
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.av_daemon.source import Capture

CHUNK_S = 0.02  # of sound in one frame
_BUFFER_S = 0.5  # what ALSA holds while this process is busy
_BEHIND = 10  # chunks; further behind, it skips to the newest


class AlsaMicrophone(CaptureProgram):
    """A microphone by ``arecord``: s16le, 20 ms a piece; none is lost unless this process is late by 200 ms."""

    def __init__(self, options: AvDaemon) -> None:
        audio = options.audio
        if shutil.which("arecord") is None:
            raise DeviceError("arecord is not installed: sudo apt install alsa-utils")
        self._size = round(audio.rate * CHUNK_S) * 2 * audio.channels
        self._info = FrameInfo(format="s16le", rate=audio.rate, channels=audio.channels)
        self._buffer = bytearray()
        command = [
            "arecord", "--quiet", "--file-type=raw", "--format=S16_LE",
            f"--rate={audio.rate}", f"--channels={audio.channels}",
            f"--period-time={CHUNK_S * 1e6:.0f}", f"--buffer-time={_BUFFER_S * 1e6:.0f}",
            *([f"--device={audio.device}"] if audio.device is not None else []),
        ]  # fmt: skip
        super().__init__(command)

    def grab(self) -> Capture:
        """Return the next chunk, with the time of its recording; or the newest one, if too many wait."""
        while len(self._buffer) < self._size:
            self._buffer += self.read()
        behind = len(self._buffer) // self._size - 1
        skipped = behind if behind > _BEHIND else 0
        del self._buffer[: skipped * self._size]
        chunk = bytes(self._buffer[: self._size])
        del self._buffer[: self._size]
        late_s = len(self._buffer) // self._size * CHUNK_S  # what waits behind it was recorded after it
        at_ns = time.monotonic_ns() - int(late_s * 1e9)
        return Capture(self._info, self._size, chunk, at_ns=at_ns, skipped=skipped)
