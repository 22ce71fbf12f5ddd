"""The sound of a film, or a recording's sound alone, as a wav file."""

from __future__ import annotations

import wave
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.recordings.files.recorded import RecordingError

if TYPE_CHECKING:
    from pebble.extensions.media.pcm import Resampler, Samples
    from pebble.extensions.media.sound import ReceivedSound

RATE: Final = 48_000  # Hz of the film's sound, whatever was sent: the rate of Opus
_HOLE_MS: Final = 500  # sound that is missing for longer becomes silence; less is a delay of the network
_WAV_BYTES: Final = (1 << 32) - (1 << 16)  # the format's lengths have 32 bits


@dataclass(slots=True)
class SoundResult:
    """The contents of a film's sound."""

    seconds: float = 0.0
    silence_s: float = 0.0  # of these: no sound was received
    packets: int = 0
    left_out: int = 0  # packets: damaged, or of a time that already had sound


class SoundTrack:
    """The film's sound as a wav file, with silence where none was received.

    The first packet decides between mono and stereo.
    """

    def __init__(self, path: Path) -> None:
        from pebble.extensions.media.sound import SoundDecoder

        self.path = path
        self.result = SoundResult()
        self._decoder = SoundDecoder()
        self._file: Any = None
        self._channels = 0
        self._written = 0  # samples
        self._format = (0, 0)  # rate and channels for which the resampler was made
        self._resampler: Resampler | None = None

    def __enter__(self) -> SoundTrack:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, payload: bytes, at_ms: int) -> None:
        """Add a packet at ``at_ms``, or directly after the previous one if its end is near."""
        sound = self._decoder.feed(payload)
        if sound is None:
            self.result.left_out += 1
            return
        if self._file is None:
            self._open(1 if sound.channels == 1 else 2)
        samples = self._resampled(sound)
        missing = at_ms * RATE // 1000 - self._written
        if missing > _HOLE_MS * RATE // 1000 or not self._written:
            self._silence(missing)
        elif missing < -_HOLE_MS * RATE // 1000:
            samples = samples[-missing:]  # the first ones are of a time that already has sound
        if len(samples):
            self.result.packets += 1
            self._write(samples)
        else:
            self.result.left_out += 1

    def _open(self, channels: int) -> None:
        self._channels = channels
        self._file = wave.open(str(self.path), "wb")  # noqa: SIM115 - closed by __exit__
        self._file.setparams((channels, 2, RATE, 0, "NONE", ""))

    def _resampled(self, sound: ReceivedSound) -> Samples:
        from pebble.extensions.media.pcm import Resampler, remix

        if self._resampler is None or self._format != (sound.rate, sound.channels):
            self._resampler = Resampler(sound.rate, RATE, self._channels)
            self._format = sound.rate, sound.channels
        return self._resampler.feed(remix(sound.samples, self._channels))

    def _silence(self, samples: int) -> None:
        import numpy as np

        self.result.silence_s += samples / RATE
        while samples > 0:
            part = min(samples, RATE)
            self._write(np.zeros((part, self._channels), np.int16))
            samples -= part

    def _write(self, samples: Samples) -> None:
        from pebble.extensions.media.pcm import to_bytes

        self._written += len(samples)
        if self._written * self._channels * 2 > _WAV_BYTES:
            raise RecordingError(f"more than {self._written // RATE // 3600} hours of sound: choose a shorter time")
        self._file.writeframesraw(to_bytes(samples))
        self.result.seconds = self._written / RATE
