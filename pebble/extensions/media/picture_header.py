"""Reads the header around a picture on the wire, without decoding the picture. Pure; needs neither cv2 nor PyAV."""

from typing import Annotated, Final, NamedTuple

import msgspec

from pebble.errors import PayloadError
from pebble.extensions.media.packets import KEY_FRAME, PBVD, SEQUENCE_LIMIT, Picture, PictureKind

MAX_PAYLOAD: Final = 4 << 20  # bytes of one picture
_HEADER_BYTES: Final = 19
_SOI: Final = b"\xff\xd8"
#: With more time between two pictures, or less than none, the sender may have restarted and the number fits by chance.
_LONGEST_STEP_MS: Final = 5000
_MILLISECONDS_FROM: Final = 1e11  # a timestamp as large as this is in milliseconds
_LATEST_MS: Final = 253_402_300_800_000  # the year 10000

_KINDS: Final = {
    PictureKind.JPEG: ("pbvd", True),
    PictureKind.DELTA_JPEG: ("pbvd", False),
    PictureKind.ZLIB_JPEG: ("pbvz", True),  # of recordings: robots no longer send it
    PictureKind.ZLIB_DELTA_JPEG: ("pbvz", False),
}


class _JsonHead(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
    keyframe: bool
    timestamp: float | None = None


_json = msgspec.json.Decoder(_JsonHead)


class PictureHeader(NamedTuple):
    """The header. ``keyframe``: no earlier picture is needed. ``frame`` and ``captured_ms``: None if missing."""

    encoding: str  # json | pbvd | pbvz | h264 | jpeg
    keyframe: bool
    frame: int | None
    captured_ms: int | None


def read_header(payload: bytes) -> PictureHeader | None:
    """Return the header of a payload of any encoding; None if it is no picture."""
    if payload.startswith(PBVD):
        return _read_pbvd(payload)
    if payload.startswith(_SOI):
        return PictureHeader("jpeg", True, None, None)
    return _read_json(payload) if payload[:1] in (b"{", b" ", b"\t", b"\r", b"\n") else None


def follows(last: PictureHeader | None, header: PictureHeader) -> bool:
    """True if a receiver that has decoded ``last`` can decode this one."""
    if header.keyframe:
        return True
    if last is None or last.encoding != header.encoding or header.frame != _after(last):
        return False
    if last.captured_ms is None or header.captured_ms is None:
        return last.captured_ms == header.captured_ms  # a sender stamps all its pictures or none
    return 0 <= header.captured_ms - last.captured_ms <= _LONGEST_STEP_MS


class PictureSequence:
    """A detector of missing pictures: those after a missing picture are of no use until the next key frame."""

    def __init__(self) -> None:
        self.complete = False  # no picture is missing before the newest
        self._last: PictureHeader | None = None

    def take(self, payload: bytes) -> PictureHeader | None:
        """Return the header of the next payload; None if it is no picture, or too large."""
        header = read_header(payload) if len(payload) <= MAX_PAYLOAD else None
        self.complete = header is not None and follows(self._last, header)
        self._last = header if self.complete else None
        return header

    def interrupt(self) -> None:
        """Treat the next picture as one that follows a missing picture."""
        self.complete, self._last = False, None


def _after(last: PictureHeader) -> int | None:
    """Return the number of the picture after ``last``; None if its encoding has no numbers."""
    if last.frame is None:
        return None
    return last.frame + 1 if last.encoding == "json" else (last.frame + 1) % SEQUENCE_LIMIT


def _read_pbvd(payload: bytes) -> PictureHeader | None:
    try:
        head = Picture.unpack(payload[:_HEADER_BYTES])
    except PayloadError:
        return None
    captured_ms = _plausible(head.captured_ms)
    if head.kind == PictureKind.H264:
        return PictureHeader("h264", bool(head.flags & KEY_FRAME), head.frame, captured_ms)
    if head.kind not in _KINDS:
        return None
    encoding, keyframe = _KINDS[PictureKind(head.kind)]
    return PictureHeader(encoding, keyframe, head.frame, captured_ms)


def _read_json(payload: bytes) -> PictureHeader | None:
    try:
        head = _json.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError):
        return None
    return PictureHeader("json", head.keyframe, head.id, _milliseconds(head.timestamp))


def _milliseconds(stamp: float | None) -> int | None:
    if stamp is None or not 0 < stamp < _LATEST_MS:  # nor NaN: then neither is true
        return None
    return _plausible(round(stamp if stamp >= _MILLISECONDS_FROM else stamp * 1000))


def _plausible(captured_ms: int) -> int | None:
    """Return ``captured_ms`` if it can be written as a date, else None."""
    return captured_ms if 0 < captured_ms < _LATEST_MS else None
