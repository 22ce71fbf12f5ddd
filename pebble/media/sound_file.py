"""Compressed sound files as samples, a piece at a time, by PyAV; and a writer of wav files."""

from __future__ import annotations

import wave
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

from pebble.errors import PebbleError
from pebble.media import pyav
from pebble.media.pcm import Samples, to_bytes

#: PyAV's names of the formats, by the ending of the file: what a file holds does not choose its reader, because some
#: formats of FFmpeg are lists of other files and hosts.
_FORMATS: Final = {".mp3": "mp3", ".ogg": "ogg", ".flac": "flac"}


class SoundFile:
    """An open file. ``rate`` is in Hz; ``channels`` is 1 or 2."""

    def __init__(self, path: Path) -> None:
        """Raises PebbleError if there is no sound in it, and OSError if it cannot be read."""
        self._name = path.name
        self._resources = ExitStack()
        self.rate, self.channels, self._pieces = self._decoded(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    def chunks(self) -> Iterator[bytes]:
        """Interleaved s16le until the end. Raises PebbleError where it cannot be decoded."""
        for samples in self._pieces:
            yield to_bytes(samples)

    def _decoded(self, path: Path) -> tuple[int, int, Iterator[Samples]]:
        av = pyav.load(path.suffix.removeprefix("."))
        try:
            container = self._resources.enter_context(av.open(str(path), format=_FORMATS[path.suffix.lower()]))
            stream = next(iter(container.streams.audio), None)
            if stream is None or not stream.rate or not stream.channels:
                raise PebbleError(f"there is no sound in {self._name}")
            rate, channels = stream.rate, 1 if stream.channels == 1 else 2
            resampler = av.AudioResampler(format="s16", layout="mono" if channels == 1 else "stereo", rate=rate)
        except (av.error.FFmpegError, ValueError) as error:
            raise self._undecodable(error) from None

        def pieces() -> Iterator[Samples]:
            try:
                for frame in container.decode(stream):
                    yield from _resampled(resampler, frame, channels)
                yield from _resampled(resampler, None, channels)
            except (av.error.FFmpegError, ValueError) as error:
                raise self._undecodable(error) from None

        return rate, channels, pieces()

    def _undecodable(self, error: Exception) -> PebbleError:
        return PebbleError(f"{self._name} cannot be decoded: {getattr(error, 'strerror', None) or error}")


def write_wav(path: Path, samples: bytes, rate: int) -> None:
    """One channel of s16le as a wav file."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(samples)


def _resampled(resampler: Any, frame: Any, channels: int) -> Iterator[Samples]:
    for made in resampler.resample(frame):
        yield made.to_ndarray().reshape(-1, channels)
