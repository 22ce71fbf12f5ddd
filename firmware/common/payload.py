"""Reads drive-values messages, and computes wheel speeds from them (paper A.8.3), in a few hundred bytes. Pure."""

import json

from micropython import const

from common.arbiter import LAST_RUN, PERSON, UNKNOWN_RUN

_MAX_BYTES = const(512)
_MAX_BRACKETS = const(32)  # limits the parser's memory, which grows with depth
_WATCHDOG_MS = const(60_000)  # longer than any: larger numbers are cut, because they would need memory


def load(raw: memoryview | bytes):
    """Return parsed JSON of limited size and depth. Raises ValueError, OverflowError or MemoryError.

    Programs may add a byte order mark, white space, or a C string's NUL and the rest of its buffer. These are removed:
    JSON begins and ends with printable ASCII. Bytes from 0xF5 on are kept, to be refused: UTF-8 never has them.
    """
    size = len(raw)
    if size > _MAX_BYTES:
        raise ValueError
    first = 0
    while first < size and (raw[first] < 0x21 or 0x7E < raw[first] < 0xF5):
        first += 1
    last = first
    while last < size and raw[last]:
        last += 1
    while first < last and (raw[last - 1] < 0x21 or 0x7E < raw[last - 1] < 0xF5):
        last -= 1
    raw = raw[first:last]
    brackets = highest = 0
    for byte in raw:
        highest = max(highest, byte)
        if byte == 0x5B or byte == 0x7B:  # [ or {
            brackets += 1
    if brackets > _MAX_BRACKETS:
        raise ValueError
    if highest > 127:
        bytes(raw).decode()  # parsers of boards do not check for UTF-8
    return json.loads(raw)  # type: ignore[type-var]  # any buffer will do (extmod/modjson.c)


def parse(raw: memoryview | bytes, grouped: bool = False) -> tuple[float, float, float, int, int, str] | None:
    """Return ``(x, z, y, run, valid_ms, key)`` from bare or wrapped JSON; None if the command is refused.

    Axes are limited to -1..1; missing ones, and those that are no number, are 0; NaN and infinity are refused. The
    other values are as the arbiter needs them. If one of these or ``source`` is wrong, only a zero is admitted.
    ``grouped``: the command is a member of a group. If that has other members, too, only a zero is admitted.
    """
    try:
        body = load(raw)
        alone = True  # no other member, nor this one twice: a parser keeps the last of equal keys
        if grouped and isinstance(body, dict):
            alone = len(body) == 1 and bytes(raw).count(b'"drive-values"') == 1
            body = body.get("drive-values")
        if isinstance(body, dict):
            inner = body.get("value")
            if isinstance(inner, dict):
                body = inner
            x, z, y = _axis(body, "x"), _axis(body, "z"), _axis(body, "y")
            stops = x == 0.0 and z == 0.0 and y == 0.0
            run, valid_ms = _run(body, stops), _valid_ms(body, stops)
            key = body.get("key")
            if not stops and not (alone and (key is None or isinstance(key, str))):
                raise ValueError
            return x, z, y, run, valid_ms, key if isinstance(key, str) else ""
    except (ValueError, OverflowError, MemoryError):  # not UTF-8, no JSON, no number
        pass
    return None


def _run(body: dict, stops: bool) -> int:
    """Return the number of the script's run, PERSON or UNKNOWN_RUN; ``stops``: all axes are 0.

    Raises ValueError for what is wrong in a command that moves anything.
    """
    source = body.get("source")
    run = body.get("run")
    if run is not None and not (type(run) is int and 1 <= run <= LAST_RUN):
        run = UNKNOWN_RUN
    if not stops and (run == UNKNOWN_RUN or not (source is None or isinstance(source, str))):
        raise ValueError  # a wrong run, or a wrong source
    if source != "autonomy":  # any other source is a person
        return PERSON
    if run is None:
        if not stops:
            raise ValueError
        run = UNKNOWN_RUN
    return run


def _valid_ms(body: dict, stops: bool) -> int:
    """Return the limit in the command; -1: there is none, or a wrong one in a zero. ``stops``: all axes are 0.

    Raises ValueError for a wrong one in a command that moves anything.
    """
    value = body.get("valid_ms")
    if value is not None:
        if type(value) in (int, float) and 0 <= value < 1e12 and (stops or value >= 1):
            return int(min(value, _WATCHDOG_MS))
        if not stops:
            raise ValueError
    return -1


def _axis(body: dict, name: str) -> float:
    """Return an axis, -1..1, also from a text; 0 if it is missing or no number. Raises ValueError for NaN, infinity."""
    value = body.get(name)
    if isinstance(value, str):
        value = _number(value.strip(" \t\n\r\v\f").lower())
    elif type(value) not in (int, float):
        return 0.0
    value = float(value)  # type: ignore[arg-type]
    if not -1e999 < value < 1e999:  # NaN or infinite; arithmetic would allocate memory
        raise ValueError
    return clamp(value)


def _number(text: str) -> float:
    """Return the number in ``text``; 0 if Linux robots do not read it as a number.

    float() of a board does not decide that: it also accepts 1_0, "." and "e5".
    """
    if "nan" in text or "inf" in text:  # refused, as `_axis` refuses them as numbers
        raise ValueError
    if text.strip("0123456789+-.e") or not text.split("e")[0].strip("+-."):  # another letter, or no digit before e
        return 0.0
    try:
        return float(text)
    except ValueError:
        return 0.0


def clamp(value: float) -> float:
    """Limit ``value`` to -1..1."""
    return -1.0 if value < -1.0 else 1.0 if value > 1.0 else value


def mix(x: float, z: float) -> tuple[float, float]:
    """Return left and right wheel speed, -1..1, + = forward; ``x`` steers, + = right; ``z`` is the throttle."""
    return clamp(z + x), clamp(z - x)
