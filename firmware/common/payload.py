"""What a drive-values message asks for (paper A.8.3): the meaning of pebble/codec.py in a few hundred bytes. Pure."""

import json

from micropython import const

from common.wheels import clamp

_MAX_BYTES = const(1024)
_MAX_BRACKETS = const(32)  # a parser's memory grows with depth, so nobody may ask for more


def wanted(raw: memoryview | bytes) -> tuple[float, float, float] | None:
    """``(x, z, y)`` within -1..1 from bare or wrapped JSON; missing axes are 0. None: refused."""
    if len(raw) > _MAX_BYTES:
        return None
    brackets = highest = 0
    for byte in raw:
        highest = max(highest, byte)
        if byte == 0x5B or byte == 0x7B:  # [ or {
            brackets += 1
    if brackets > _MAX_BRACKETS:
        return None
    try:
        if highest > 127:
            bytes(raw).decode()  # parsers of boards do not look whether it is UTF-8
        body = json.loads(raw)  # type: ignore[type-var]  # any buffer will do (extmod/modjson.c)
        if isinstance(body, dict):
            inner = body.get("value")
            if isinstance(inner, dict):
                body = inner
            return _axis(body, "x"), _axis(body, "z"), _axis(body, "y")
    except (ValueError, OverflowError, MemoryError):  # not UTF-8, no JSON, no number
        pass
    return None


def _axis(body: dict, name: str) -> float:
    value = body.get(name, 0)
    if isinstance(value, str):
        value = value.strip().lower()
        if not value.split("e")[0].strip("+-."):  # a board's float() takes "." and "e5" for 0
            raise ValueError
        for char in value:
            if char not in "0123456789+-.e":  # it would also take nan, inf and 1_0
                raise ValueError
    elif isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError
    value = float(value)
    if value - value != 0.0:  # NaN or infinite
        raise ValueError
    return clamp(value)
