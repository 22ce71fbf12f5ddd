"""Time stamps in payloads, and whether a payload is media. Pure.

JSON has ``t`` in milliseconds or ``timestamp`` in seconds (paper A.4.2); media have a stamp in the header
(``pebble.extensions.media.packets``).
"""

from dataclasses import replace
from typing import Any, Final

import msgspec

from pebble.errors import PayloadError
from pebble.extensions.media.packets import PBAT, PBVD, Picture, Sound
from pebble.extensions.media.picture_header import read_header

_MILLISECONDS_FROM: Final = 10**11  # a stamp as large as this is in milliseconds
CLOCK_FROM_NS: Final = 10**18  # 2001: a smaller stamp counts from the start of a board, not from 1970
_LATEST_NS: Final = (1 << 63) - 1
_MEDIA_HEAD: Final = 24  # bytes: the longer one of both headers
_PICTURE_HEAD: Final = 64  # bytes in which a JSON picture has its first two keys
_JPEG: Final = b"\xff\xd8"


class _Stamped(msgspec.Struct):
    t: int | float | None = None
    timestamp: int | float | None = None


_stamped = msgspec.json.Decoder(_Stamped)


def stamp_ns(payload: bytes) -> int:
    """Return the payload's own stamp in nanoseconds since 1970; 0 if it has none, or an impossible one.

    Called for each message.
    """
    first = payload[:1]
    if first == b"{":
        try:
            stamps = _stamped.decode(payload)
        except (ValueError, RecursionError):  # msgspec's are ValueErrors
            return 0
        return _in_ns(stamps.timestamp if stamps.t is None else stamps.t)  # seconds or milliseconds: the number tells
    header = _media_header(payload[:_MEDIA_HEAD]) if first == b"P" else None
    return 0 if header is None else _in_ns(header.captured_ms, 10**6)


def shifted(payload: bytes, by_ns: int) -> bytes:
    """Return ``payload`` with its stamps moved by ``by_ns``, in their units.

    Stamps that do not count from 1970, and those that would leave the range of a clock, stay as they are.
    """
    if payload[:1] == b"{":
        return _shifted_json(payload, by_ns)
    header = _media_header(payload)
    if header is None or not _can_move(_in_ns(header.captured_ms, 10**6), by_ns):
        return payload
    return replace(header, captured_ms=header.captured_ms + by_ns // 10**6).pack()


def is_media(payload: bytes) -> bool:
    """True if the payload is a picture or sound, by its first bytes, because a robot may rename its topics."""
    return payload[:4] in (PBVD, PBAT) or is_picture(payload)


def is_picture(payload: bytes) -> bool:
    """True if the payload is a picture: PBVD, a JPEG or JSON with ``id`` and ``keyframe``."""
    if payload[:4] == PBVD or payload[:2] == _JPEG:
        return True
    return payload[:6] == b'{"id":' and b'"keyframe"' in payload[:_PICTURE_HEAD]


def is_keyframe(payload: bytes) -> bool:
    """True if the payload is a picture that can be decoded without earlier pictures."""
    header = read_header(payload) if is_picture(payload) else None
    return header is not None and header.keyframe


def _media_header(payload: bytes) -> Picture | Sound | None:
    """Return the header of a picture or sound; None if it is neither, or cut off."""
    try:
        return Sound.unpack(payload) if payload[:4] == PBAT else Picture.unpack(payload)
    except PayloadError:
        return None


def _in_ns(stamp: float | None, unit: int = 0) -> int:
    """Return a stamp in nanoseconds, exact to a microsecond; 0 if it is not a stamp.

    ``unit``: in nanoseconds; 0: guessed from the stamp's size.
    """
    if stamp is None or not 0 < stamp < _LATEST_NS:
        return 0
    ns = round(stamp * (unit or _unit(stamp)) / 1000) * 1000
    return ns if ns <= _LATEST_NS else 0


def _unit(stamp: float) -> int:
    return 10**6 if stamp >= _MILLISECONDS_FROM else 10**9


def _can_move(ns: int, by_ns: int) -> bool:
    """True if a stamp counts from 1970, and moving it does not leave the range of a clock."""
    return ns >= CLOCK_FROM_NS and 0 < ns + by_ns <= _LATEST_NS


def _shifted_json(payload: bytes, by_ns: int) -> bytes:
    try:
        plain: dict[str, Any] = msgspec.json.decode(payload)
    except (ValueError, RecursionError):
        return payload
    moved = {}
    for name in _Stamped.__struct_fields__:
        stamp = plain.get(name)
        if not isinstance(stamp, int | float) or isinstance(stamp, bool) or not _can_move(_in_ns(stamp), by_ns):
            continue
        unit = _unit(stamp)  # an int stays an int
        moved[name] = stamp + (by_ns / unit if isinstance(stamp, float) else by_ns // unit)
    return msgspec.json.encode(plain | moved) if moved else payload
