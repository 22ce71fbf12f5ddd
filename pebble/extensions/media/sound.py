"""Encodes sound to PBAT packets, and decodes them. The jitter buffer puts them in order and times them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from pebble.contract.encodings import ALL_SOUND
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media import opus, pyav
from pebble.extensions.media.opus import OpusDecoder, OpusEncoder
from pebble.extensions.media.packets import SEQUENCE_LIMIT, Codec, Sound
from pebble.extensions.media.pcm import Resampler, Samples, remix, to_bytes, to_samples
from pebble.transports.counters import Counters

#: The encodings that this installation can make.
SOUND_ENCODINGS: Final = pyav.available(ALL_SOUND)

CHANNELS_LIMIT: Final = 8  # channels of one stream of sound
LOWEST_RATE: Final = 4000  # Hz; a player would fail with less
_HEADER_LIMIT = 65_535  # the highest rate, and number of samples in a packet, that the header can express
_LONGEST_S = 1.0  # of one packet: the most the original can be configured to send
_GAP_MS = 60  # if a chunk begins further than this from the end of the last one, sound is missing between them


def sequence_numbers() -> Iterator[int]:
    """Yield 1, 2, 3 … 0xFFFFFFFF, 1 …: a number for each packet of a process, of any encoding."""
    while True:
        yield from range(1, SEQUENCE_LIMIT)


class _Intake:
    """A converter of sound to the rate and channels on the wire, cut into equal frames."""

    def __init__(self, rate: int, channels: int, rate_out: int, channels_out: int) -> None:
        self.rate, self.channels = rate_out, channels_out
        self._fed_rate, self._fed_channels = rate, channels
        self._resampler = Resampler(rate, rate_out, channels_out)
        self._left = np.zeros((0, channels_out), np.int16)  # less than a frame, for the next one
        self._next_ms: float | None = None  # when the first sample of the next chunk should have been captured

    def has_gap(self, captured_ms: int) -> bool:
        """True if sound is missing before ``captured_ms``. Then the remaining samples before it are dropped."""
        if self._next_ms is None or abs(captured_ms - self._next_ms) <= _GAP_MS:
            return False
        self._left = self._left[:0]
        return True

    def frames(self, pcm: bytes, captured_ms: int, size: int) -> Iterator[tuple[Samples, int]]:
        """Yield frames of ``size`` samples, each with the epoch milliseconds of its first sample."""
        fed = to_samples(pcm, self._fed_channels)
        start_ms = captured_ms - 1000 * len(self._left) / self.rate
        samples = np.concatenate((self._left, self._resampler.feed(remix(fed, self.channels))))
        whole = len(samples) // size * size
        for at in range(0, whole, size):
            yield samples[at : at + size], round(start_ms + 1000 * at / self.rate)
        self._left = samples[whole:]
        self._next_ms = captured_ms + 1000 * len(fed) / self._fed_rate


class SoundEncoder:
    """An encoder that takes any amount of s16le and returns whole packets; the remaining samples wait for more.

    A packet holds ``bundle`` Opus packets, or the samples unchanged if there is no ``codec``. ``numbers``: of packets.
    """

    def __init__(
        self, intake: _Intake, numbers: Iterator[int], frame_ms: int, codec: OpusEncoder | None = None, bundle: int = 1
    ) -> None:
        self.name = "pcm" if codec is None else "opus"
        self.rate, self.channels = intake.rate, intake.channels  # of what is sent
        self._intake, self._numbers, self._codec, self._bundle = intake, numbers, codec, bundle
        self._samples = min(max(1, self.rate * frame_ms // 1000), _HEADER_LIMIT)  # of a frame
        self._ready: list[bytes] = []  # encoded frames of the packet that is not complete
        self._ready_ms = 0  # when the first of them was captured

    @property
    def part_way(self) -> bool:
        """True if an unfinished PBAT packet already holds encoded sound."""
        return bool(self._ready)

    def encode(self, pcm: bytes, captured_ms: int) -> list[bytes]:
        """Return the PBAT packets that are now complete; ``captured_ms`` is the epoch time of the first sample."""
        packets = []
        if self._intake.has_gap(captured_ms):
            self._ready = []  # from before the gap: a packet has one time stamp
        for frame, first_ms in self._intake.frames(pcm, captured_ms, self._samples):
            if not self._ready:
                self._ready_ms = first_ms
            self._ready += [to_bytes(frame)] if self._codec is None else self._codec.encode(frame)
            if len(self._ready) >= self._bundle:
                packets.append(self._packet())
        return packets

    def _packet(self) -> bytes:
        """Return the packet of the frames that are ready: ``bundle`` of them, or a single one without a codec."""
        ready, self._ready = self._ready, []
        samples, first_ms = len(ready) * self._samples, max(0, self._ready_ms)
        if self._codec is None:
            codec, body = Codec.PCM16LE, ready[0]
        else:
            codec, body = Codec.OPUS, opus.join(ready)
        return Sound(codec, self.channels, self.rate, samples, next(self._numbers), first_ms, body).pack()


def make_sound_encoder(
    name: str,
    *,
    rate: int,
    channels: int,
    chunk_ms: int = 20,
    bitrate: int = 24_000,
    bundle: int = 1,
    sent_rate: int | None = None,
    sent_channels: int | None = None,
    numbers: Iterator[int] | None = None,
) -> SoundEncoder:
    """Return an encoder of sound with ``rate`` and ``channels``.

    It sends at ``sent_rate`` with ``sent_channels``, or the nearest that the encoding has. Opus packets last
    ``chunk_ms`` rounded up to 20, 40 or 60, and ``bundle`` of them (at most 3) share a PBAT packet. Raises PebbleError
    for an encoding that is unknown, or not installed.
    """
    numbers = sequence_numbers() if numbers is None else numbers
    rate_out, channels_out = sent_rate or rate, sent_channels or channels
    if name == "pcm":
        rate_out = rate_out if rate_out <= _HEADER_LIMIT else opus.RATES[-1]  # the header cannot hold it
        return SoundEncoder(_Intake(rate, channels, rate_out, channels_out), numbers, chunk_ms)
    if name == "opus":
        rate_out = next((opus_rate for opus_rate in opus.RATES if opus_rate >= rate_out), opus.RATES[-1])
        intake = _Intake(rate, channels, rate_out, channels_out if channels_out <= 2 else 1)  # mono or stereo
        frame_ms = next((ms for ms in opus.FRAMES_MS if ms >= chunk_ms), opus.FRAMES_MS[-1])
        codec = OpusEncoder(rate_out, intake.channels, frame_ms=frame_ms, bitrate=bitrate)
        return SoundEncoder(intake, numbers, frame_ms, codec, min(max(bundle, 1), opus.BUNDLE_LIMIT))
    raise PebbleError(f'there is no sound encoding "{name}": use {" or ".join(SOUND_ENCODINGS)}')


@dataclass(frozen=True, slots=True)
class DecodedSound:
    """Samples that can be played: (samples, channels)."""

    samples: Samples
    rate: int
    channels: int

    @property
    def pcm(self) -> bytes:
        """Interleaved s16le."""
        return to_bytes(self.samples)

    @property
    def seconds(self) -> float:
        return len(self.samples) / self.rate


@dataclass(frozen=True, slots=True)
class ReceivedSound(DecodedSound):
    """The sound of a packet."""

    captured_ms: int
    sequence: int
    encoding: str


def unpack(payload: bytes) -> Sound:
    """Return the PBAT packet in ``payload``. Raises PayloadError if it must not be played."""
    sound = Sound.unpack(payload)
    if sound.channels > CHANNELS_LIMIT or sound.rate < LOWEST_RATE:
        raise PayloadError(f"PBAT: {sound.channels} channels at {sound.rate} Hz cannot be played")
    if sound.samples > _LONGEST_S * sound.rate:
        raise PayloadError(f"PBAT: one packet of {sound.samples / sound.rate:.1f} s")
    if sound.codec == Codec.PCM16LE:
        if len(sound.body) < 2 * sound.samples * sound.channels:
            raise PayloadError("PBAT: fewer samples than in its header")
    elif sound.codec == Codec.OPUS and "opus" in SOUND_ENCODINGS:
        _check_opus(sound)
    else:
        raise PayloadError(f"PBAT: codec {sound.codec} is unknown")
    return sound


def _check_opus(sound: Sound) -> None:
    if sound.rate not in opus.RATES or sound.channels > 2:
        raise PayloadError(f"PBAT: no Opus has {sound.channels} channels at {sound.rate} Hz")
    if sound.samples * 1000 != sum(map(opus.milliseconds, opus.split(sound.body))) * sound.rate:
        raise PayloadError("PBAT: not as many samples as its Opus packets hold")


class SoundDecoder:
    """A decoder of packets to samples, in the order of :meth:`feed`; codec, rate and channels may change at any time.

    ``counters``: packets, refused.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._format = (0, 0, 0)  # codec, rate and channels of the last packet
        self._opus: OpusDecoder | None = None

    def feed(self, payload: bytes) -> ReceivedSound | None:
        """Return the sound of one MQTT payload; None if it cannot be played."""
        try:
            return self.decode(unpack(payload))
        except PayloadError:
            self.counters.add("refused")
            return None

    def decode(self, sound: Sound) -> ReceivedSound:
        """Return the sound of a packet from :func:`unpack`. Raises PayloadError if it cannot be decoded.

        Raises PebbleError for Opus if PyAV is not installed.
        """
        format_ = (sound.codec, sound.rate, sound.channels)
        if format_ != self._format:
            self._opus = OpusDecoder(sound.rate, sound.channels) if sound.codec == Codec.OPUS else None
            self._format = format_
        samples = self._samples(sound)
        self.counters.add("packets")
        encoding = "pcm" if self._opus is None else "opus"
        return ReceivedSound(samples, sound.rate, sound.channels, sound.captured_ms, sound.sequence, encoding)

    def conceal(self) -> Samples | None:
        """Return the codec's estimate of one more frame; None if it makes none."""
        if self._opus is None:
            return None
        samples = self._opus.conceal()
        return samples if len(samples) else None

    def _samples(self, sound: Sound) -> Samples:
        if self._opus is None:
            return to_samples(sound.body[: 2 * sound.samples * sound.channels], sound.channels)
        return np.concatenate([self._opus.decode(packet) for packet in opus.split(sound.body)])
