"""What is said about a frame, beside its bytes."""

from __future__ import annotations

import msgspec


class FrameInfo(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """MessagePack in the attachment of a frame. Fields are only ever added at the end, with defaults."""

    sequence: int = 0  # set by the writer: 1, 2, 3 … within one writer's life
    writer: int = 0  # set by the writer: random, another life has another
    captured_ns: int = 0  # CLOCK_MONOTONIC when the frame was complete at the device
    captured_ms: int = 0  # the same moment in milliseconds since the epoch
    format: str = ""  # bgr24 | nv12 | yuyv | mjpeg | s16le
    width: int = 0  # pixels
    height: int = 0
    stride: int = 0  # bytes per row; 0 for mjpeg, and where rows follow each other without a gap
    rate: int = 0  # sound: samples per second and channel
    channels: int = 0  # interleaved


encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(FrameInfo).decode


def decode(attachment: bytes) -> FrameInfo | None:
    """None for what is no FrameInfo."""
    try:
        return _decode(attachment)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
