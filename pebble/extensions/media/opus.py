"""Opus for PBAT codec 2, by PyAV's libopus, and the form in which several Opus packets share a PBAT body.

The body is one or more Opus packets, each after its length in bytes as a big-endian u16. They all belong to one time
stamp; ``samples`` in the header counts what they decode to together, at the header's rate, one of RATES. Several short
packets are used instead of a long one because a decoder conceals each lost packet by itself.

Facts: RFC 6716 (3.1: the first byte tells a packet's duration; a frame that consists of its first byte only asks the
decoder to conceal one). FFmpeg's decoder always yields 48 kHz, and has no other way to conceal. The in-band FEC in the
next packet is used only by decoders that have a libopus of their own.
"""

import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media import pyav
from pebble.extensions.media.pcm import Resampler, Samples

RATES: Final = (8000, 12000, 16000, 24000, 48000)
FRAMES_MS: Final = (20, 40, 60)
BUNDLE_LIMIT: Final = 3  # Opus packets in one of ours
_DECODED_RATE = 48_000
_EXPECTED_LOSS = 10  # per cent; how much of the bitrate FEC may have
_LENGTH = struct.Struct(">H")


def _layout(channels: int) -> str:
    return "mono" if channels == 1 else "stereo"


def join(packets: list[bytes]) -> bytes:
    """Return Opus packets as one PBAT body."""
    return b"".join(_LENGTH.pack(len(packet)) + packet for packet in packets)


def split(body: bytes) -> list[bytes]:
    """Return the Opus packets of a PBAT body.

    Raises PayloadError unless the body consists of 1 to BUNDLE_LIMIT whole packets.
    """
    packets = list(_pieces(body))
    if not 1 <= len(packets) <= BUNDLE_LIMIT:
        raise PayloadError(f"PBAT: {len(packets)} Opus packets in one body")
    return packets


def _pieces(body: bytes) -> Iterator[bytes]:
    """Yield the Opus packets of a body, without their lengths. Raises PayloadError."""
    end = 0  # of the last packet
    while end < len(body):
        start = end + _LENGTH.size
        size = _LENGTH.unpack_from(body, end)[0] if start <= len(body) else 0
        end = start + size
        if not size or end > len(body):
            raise PayloadError("PBAT: an Opus packet is empty or cut off")
        yield body[start:end]


def milliseconds(packet: bytes) -> float:
    """Return the duration of an Opus packet, by its first byte or two (RFC 6716, 3.1 and 3.2)."""
    mode, code = packet[0] >> 3, packet[0] & 3
    if mode < 12:  # SILK
        frame_ms: float = (10, 20, 40, 60)[mode % 4]
    elif mode < 16:  # both
        frame_ms = (10, 20)[mode % 2]
    else:  # CELT
        frame_ms = (2.5, 5, 10, 20)[mode % 4]
    if code == 0:
        count = 1
    elif code < 3:
        count = 2
    else:  # any number of frames, in the second byte
        count = packet[1] & 0x3F if len(packet) > 1 else 0
    return frame_ms * count


def _codec(av: Any, mode: str) -> Any:
    try:
        return av.CodecContext.create("libopus", mode)
    except ValueError as error:  # PyAV's UnknownCodecError is one
        raise PebbleError(f"this PyAV has no libopus: {error}") from None


class OpusEncoder:
    """An encoder of frames of ``frame_ms`` (one of FRAMES_MS) at one of RATES, mono or stereo, to one packet each."""

    def __init__(self, rate: int, channels: int, *, frame_ms: int, bitrate: int) -> None:
        self._av = pyav.load("opus")
        self.samples = rate * frame_ms // 1000
        self._rate, self._layout = rate, _layout(channels)
        codec = _codec(self._av, "w")
        codec.sample_rate, codec.layout, codec.format, codec.bit_rate = rate, self._layout, "s16", bitrate
        codec.options = {
            "application": "voip",
            "frame_duration": str(frame_ms),
            "fec": "1",
            "packet_loss": str(_EXPECTED_LOSS),
        }
        codec.open()
        self._codec = codec

    def encode(self, frame: Samples) -> list[bytes]:
        """Return one packet; ``frame`` is (self.samples, channels)."""
        interleaved = np.ascontiguousarray(frame).reshape(1, -1)
        av_frame = self._av.AudioFrame.from_ndarray(interleaved, format="s16", layout=self._layout)
        av_frame.sample_rate = self._rate
        return [bytes(packet) for packet in self._codec.encode(av_frame)]


class OpusDecoder:
    """A decoder of Opus packets to samples at ``rate`` (one of RATES), mono or stereo whatever the packets hold."""

    def __init__(self, rate: int, channels: int) -> None:
        self._av = pyav.load("opus")
        self._codec = _codec(self._av, "r")
        self._codec.sample_rate, self._codec.layout = _DECODED_RATE, _layout(channels)
        self._channels = channels
        self._resampler = Resampler(_DECODED_RATE, rate, channels)
        self._mode: bytes | None = None  # a packet of only the last one's first byte, which conceals one more

    def decode(self, packet: bytes) -> Samples:
        """Return the samples of a packet, (samples, channels). Raises PayloadError if it is no Opus packet."""
        samples = self._decode(packet)
        self._mode = bytes([packet[0] & 0xFC])  # 0xFC: one frame, not several
        return samples

    def conceal(self) -> Samples:
        """Return an estimate of one more frame, which fades as this is called again. Empty before the first packet."""
        if self._mode is None:
            return np.zeros((0, self._channels), np.int16)
        return self._decode(self._mode)

    def _decode(self, packet: bytes) -> Samples:
        try:
            frames = self._codec.decode(self._av.Packet(packet))
        except (self._av.FFmpegError, ValueError) as error:
            raise PayloadError(f"PBAT: no Opus packet: {error}") from None
        decoded = [frame.to_ndarray().reshape(-1, self._channels) for frame in frames]
        return self._resampler.feed(np.concatenate(decoded) if decoded else np.zeros((0, self._channels), np.int16))
