"""Sound files as samples, a piece at a time: wav by the standard library, other formats by PyAV."""

from __future__ import annotations

import wave
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from pebble.errors import PebbleError
from pebble.media import pyav
from pebble.media.pcm import Samples, to_bytes

#: PyAV's names of the formats, by the ending of the file: what a file holds does not choose its reader, because some
#: formats of FFmpeg are lists of other files and hosts.
_FORMATS: Final = {".wav": "wav", ".mp3": "mp3", ".ogg": "ogg", ".flac": "flac"}
_PIECE: Final = 4096  # samples of a wav file that are read at once


class SoundFile:
    """An open file. ``rate`` is in Hz; ``channels`` is 1 or 2, but those of a plain wav file may be more."""

    def __init__(self, path: Path) -> None:
        """Raises PebbleError if there is no sound in it, and OSError if it cannot be read."""
        self._name = path.name
        self._resources = ExitStack()
        self.rate, self.channels, self._pieces = self._open(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    def chunks(self, volume: float = 1.0) -> Iterator[bytes]:
        """Interleaved s16le until the end, multiplied by ``volume``. Raises PebbleError where it cannot be decoded."""
        for samples in self._pieces:
            yield to_bytes(samples if volume == 1.0 else np.rint(samples * volume).astype(np.int16))

    def _open(self, path: Path) -> tuple[int, int, Iterator[Samples]]:
        if path.suffix.lower() == ".wav":
            try:
                return self._wave(path)
            except EOFError:
                raise PebbleError(f"{self._name} is empty or cut off") from None
            except wave.Error as error:  # compressed, floating point, or no wav at all
                if not pyav.installed():
                    raise PebbleError(f"{self._name} is no plain wav file: {error}") from None
        return self._decoded(path)

    def _wave(self, path: Path) -> tuple[int, int, Iterator[Samples]]:
        file = self._resources.enter_context(wave.open(str(path), "rb"))  # noqa: SIM115 - so it is
        channels, width = file.getnchannels(), file.getsampwidth()

        def pieces() -> Iterator[Samples]:
            while raw := file.readframes(_PIECE):
                yield _samples(raw, channels, width)

        return file.getframerate(), channels, pieces()

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


def _samples(raw: bytes, channels: int, width: int) -> Samples:
    """The most significant 16 bits of samples of ``width`` bytes; those of one byte are unsigned."""
    size = channels * width
    parts = np.frombuffer(raw[: len(raw) // size * size], np.uint8).reshape(-1, width)
    if width == 1:
        return ((parts.astype(np.int16) - 128) << 8).reshape(-1, channels)
    return np.ascontiguousarray(parts[:, -2:]).view("<i2").astype(np.int16).reshape(-1, channels)


def _resampled(resampler: Any, frame: Any, channels: int) -> Iterator[Samples]:
    for made in resampler.resample(frame):
        yield made.to_ndarray().reshape(-1, channels)
