"""Reads compressed sound files as samples, a piece at a time, by PyAV; writes wav files."""

from __future__ import annotations

import wave
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Final, Self

from pebble.errors import PebbleError
from pebble.extensions.media import pyav
from pebble.extensions.media.pcm import to_bytes

#: PyAV's names of the formats, by the ending of the file: what a file holds does not choose its reader, because some
#: formats of FFmpeg are lists of other files and hosts.
_FORMATS: Final = {".mp3": "mp3", ".ogg": "ogg", ".flac": "flac"}


class SoundFile:
    """An open sound file. ``rate`` is in Hz; ``channels`` is 1 or 2."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises PebbleError if there is no sound in it, and OSError if it cannot be read."""
        self._name, self._av = path.name, pyav.load(path.suffix.removeprefix("."))  # its error names the format
        try:
            self._container = self._av.open(str(path), format=_FORMATS[path.suffix.lower()])
        except (self._av.error.FFmpegError, ValueError) as error:
            raise self._undecodable(error) from None
        self._stream = next(iter(self._container.streams.audio), None)
        if self._stream is None or not self._stream.rate or not self._stream.channels:
            self.close()
            raise PebbleError(f"there is no sound in {path.name}")
        self.rate, self.channels = self._stream.rate, min(2, self._stream.channels)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._container.close()

    def chunks(self) -> Iterator[bytes]:
        """Yield interleaved s16le until the end of the file. Raises PebbleError if it cannot be decoded."""
        layout = "mono" if self.channels == 1 else "stereo"
        try:
            resampler = self._av.AudioResampler(format="s16", layout=layout, rate=self.rate)
            for frame in chain(self._container.decode(self._stream), [None]):  # None: the samples that it still holds
                for samples in resampler.resample(frame):
                    yield to_bytes(samples.to_ndarray())
        except (self._av.error.FFmpegError, ValueError) as error:
            raise self._undecodable(error) from None

    def _undecodable(self, error: Exception) -> PebbleError:
        return PebbleError(f"{self._name} cannot be decoded: {getattr(error, 'strerror', None) or error}")


def write_wav(path: Path, samples: bytes, rate: int) -> None:
    """Write one channel of s16le as a wav file."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(samples)
