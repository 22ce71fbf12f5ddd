"""What a payload says about itself without being decoded: its own stamp, and whether it is media. Pure.

Stamps of JSON are ``t`` in milliseconds or ``timestamp`` in seconds (paper A.4.2); media have theirs in the header
(``pebble.contract.packets``).
"""

import re
from collections.abc import Iterator
from typing import Final

from pebble.contract.packets import KEY_FRAME, PBAT, PBVD, PictureKind

_TAIL, _HEAD = 64, 512  # bytes of a JSON payload in which its stamp is looked for
_STAMP: Final = re.compile(rb'"t(?:imestamp)?"\s*:\s*(-?\d+)(\.\d+)?([eE][+-]?\d+)?')
_MILLISECONDS_FROM: Final = 1e11  # a stamp as large as this is in milliseconds
CLOCK_FROM_NS: Final = 10**18  # 2001: a smaller stamp counts from the start of a board, not from 1970
_LATEST_NS: Final = (1 << 63) - 1
_SOUND_AT, _PICTURE_AT = 16, 11  # where the header of PBAT and of PBVD has its stamp: 8 bytes, milliseconds
_BACKSLASH: Final = 0x5C
_PICTURE_HEAD: Final = 64  # bytes in which a JSON picture has its first two keys
_JPEG: Final = b"\xff\xd8"
_KEYFRAME: Final = re.compile(rb'"keyframe"\s*:\s*(true|false)')
_WHOLE: Final = frozenset({PictureKind.JPEG, PictureKind.ZLIB_JPEG})


def stamp_ns(payload: bytes) -> int:
    """The payload's own stamp in nanoseconds since 1970; 0 if it has none, or one that no clock shows. Hot."""
    first = payload[:1]
    if first == b"{":
        for found in _stamps(payload):
            return _in_ns(found)
        return 0
    if first == b"P":
        at = _stamp_at(payload)
        if at:
            ns = int.from_bytes(payload[at : at + 8], "big") * 1_000_000
            return ns if ns <= _LATEST_NS else 0
    return 0


def shifted(payload: bytes, by_ns: int) -> bytes:
    """``payload`` with its own stamps moved by ``by_ns``, in their units; everything else byte for byte.

    Stamps that do not count from 1970, and those that would leave the range of a clock, stay as they are.
    """
    if payload[:1] == b"{":
        return _shifted_json(payload, by_ns)
    at = _stamp_at(payload)
    stamp = stamp_ns(payload) if at else 0
    if stamp < CLOCK_FROM_NS or not 0 < stamp + by_ns <= _LATEST_NS:
        return payload
    moved = (stamp + by_ns) // 1_000_000
    return payload[:at] + moved.to_bytes(8, "big") + payload[at + 8 :]


def is_media(payload: bytes) -> bool:
    """Whether it is a picture or sound, by its first bytes: a robot may rename its topics."""
    return payload[:4] in (PBVD, PBAT) or is_picture(payload)


def is_picture(payload: bytes) -> bool:
    """Whether it is a picture: PBVD, a JPEG or JSON with ``id`` and ``keyframe``."""
    if payload[:4] == PBVD or payload[:2] == _JPEG:
        return True
    return payload[:6] == b'{"id":' and b'"keyframe"' in payload[:_PICTURE_HEAD]


def is_keyframe(payload: bytes) -> bool:
    """Whether it is a picture that can be decoded without earlier ones."""
    if payload[:4] == PBVD:
        kind, flags = (payload[5], payload[6]) if len(payload) > _PICTURE_AT else (0, 0)
        return kind in _WHOLE or (kind == PictureKind.H264 and bool(flags & KEY_FRAME))
    if payload[:2] == _JPEG:
        return True
    found = _KEYFRAME.search(payload, 0, _PICTURE_HEAD + 16) if is_picture(payload) else None
    return found is not None and found[1] == b"true"


def _stamp_at(payload: bytes) -> int:
    """Where a media header has its stamp; 0: it is none, or cut off."""
    if payload[:4] == PBAT:
        at = _SOUND_AT
    elif payload[:4] == PBVD:
        at = _PICTURE_AT
    else:
        return 0
    return at if len(payload) >= at + 8 else 0


def _stamps(payload: bytes) -> Iterator[re.Match[bytes]]:
    """The stamps of the outermost object, first those at its end."""
    size = len(payload)
    tail = max(0, size - _TAIL)
    at_end = set()
    for found in _STAMP.finditer(payload, tail):
        after = payload[found.end() :]
        if _begins_key(payload, found) and after.count(b"}") - after.count(b"{") == 1:
            at_end.add(found.start())
            yield found
    stop = min(size, _HEAD)
    for found in _STAMP.finditer(payload, 0, stop):
        if found.start() in at_end or found.end() == stop < size:  # or a number that is cut off
            continue
        before = payload[: found.start()]
        if _begins_key(payload, found) and before.count(b"{") - before.count(b"}") == 1:
            yield found


def _begins_key(payload: bytes, found: re.Match[bytes]) -> bool:
    """Whether the quote in front is no character of a longer key."""
    return payload[found.start() - 1] != _BACKSLASH


def _in_ns(found: re.Match[bytes]) -> int:
    whole, fraction, exponent = found.groups()
    if exponent is not None:
        value = float(whole + (fraction or b"") + exponent)
        value *= 1e6 if value >= _MILLISECONDS_FROM else 1e9
        return round(value) if 0.0 < value < _LATEST_NS else 0
    number = int(whole)
    unit = 1_000_000 if number >= _MILLISECONDS_FROM else 1_000_000_000
    ns = number * unit
    if fraction is not None:
        ns = int(whole + fraction[1:]) * unit // 10 ** (len(fraction) - 1)
    return ns if 0 < ns <= _LATEST_NS else 0


def _shifted_json(payload: bytes, by_ns: int) -> bytes:
    parts, at = [], 0
    for found in sorted(_stamps(payload), key=re.Match[bytes].start):
        stamp = _in_ns(found)
        if stamp >= CLOCK_FROM_NS and 0 < stamp + by_ns <= _LATEST_NS:
            parts += [payload[at : found.start(1)], _moved(found, by_ns)]
            at = found.end()
    return b"".join([*parts, payload[at:]])


def _moved(found: re.Match[bytes], by_ns: int) -> bytes:
    """The number moved, with as many decimals as it had."""
    whole, fraction, exponent = found.groups()
    if exponent is not None:
        return b"%d" % ((_in_ns(found) + by_ns) // 1_000_000)
    decimals = len(fraction or b".") - 1
    unit = 1_000_000 if int(whole) >= _MILLISECONDS_FROM else 1_000_000_000
    digits = int(whole + (fraction or b".")[1:]) + by_ns * 10**decimals // unit
    if not decimals:
        return b"%d" % digits
    text = b"%0*d" % (decimals + 1, digits)
    return text[:-decimals] + b"." + text[-decimals:]
