"""The codec of payloads: JSON within limits, and the wrappers that the contract accepts (paper A.4.5, A.8.2)."""

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET

from pebble.contract import INCOMING, Channel
from pebble.contract import payloads as p
from pebble.errors import PayloadError
from pebble.motion.latch import fields, stop_of

MAX_COMMAND_BYTES = 64 * 1024  # a larger command is refused; a larger stop is one without a name

_LONGEST_MS = 1e12  # of a command's validity; far beyond every watchdog

# Narrower than float(), which also takes "1_0", digits of other scripts and the names of NaN and infinity.
_numeric = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII).fullmatch
#: Bytes that are removed before and after a JSON text, which begins and ends with printable ASCII: all others of UTF-8,
#: such as those of a byte order mark, a C string's NUL and white space. Bytes that UTF-8 does not have stay: a payload
#: with them is no text.
_AROUND = bytes(byte for byte in range(0xF5) if not 0x21 <= byte <= 0x7E)
_KEYS_SHOWN, _SHOWN = 8, 20  # keys of a payload that is not understood, and characters of each
_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder()


def encode(channel: Channel, value: Any) -> bytes:
    """Return the wire form of ``value``: JSON, or the bytes themselves on binary channels.

    Bytes of a name that are not UTF-8 (of a file or a user) are written as codes: ``\\udce9``.
    """
    if channel.payload is bytes:
        return bytes(value)
    body = {"value": value} if channel.payload is bool else value
    try:
        return _encoder.encode(body)
    except UnicodeEncodeError:
        return _encoder.encode(_encodable(msgspec.to_builtins(body)))


def _encodable(value: Any) -> Any:
    """Return a JSON value in which codes stand for the characters that UTF-8 cannot write."""
    if isinstance(value, dict):
        return {_encodable(key): _encodable(field) for key, field in value.items()}
    if isinstance(value, list):
        return [_encodable(item) for item in value]
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


#: Takes a command's channel, its sender if the command names one, and a remark on an effect that may be unwanted.
Remark = Callable[[Channel, str, str], None]


def decode(channel: Channel, raw: bytes, remark: Remark | None = None) -> Any:
    """Return the payload struct (or bool, or bytes) in ``raw``. Raises PayloadError that describes the problem.

    Commands may be bare or wrapped in ``{"value": …}``; boolean controls are ``true``, ``{"value": true}`` or
    ``{"enabled": true}`` and nothing else. Numbers of drive and light commands may be text.
    """
    if channel.payload is bytes:
        return raw
    if channel.payload is p.EstopCommand:
        return _stop(channel, raw)
    decoded = plain(channel, raw)
    if channel.payload is bool:
        return _boolean(channel, decoded)
    if channel.kind.direction == INCOMING:
        decoded = _unwrap(channel, decoded, remark or _ignore)
    try:
        return msgspec.convert(decoded, channel.payload)
    except (msgspec.ValidationError, ValueError, OverflowError) as error:
        # Lights once more, slower: numbers may be text (`_drive` reads those of drives), a wrong `group` is left out.
        if issubclass(channel.payload, p.LightsSolid):
            decoded = {key: value for key, value in decoded.items() if key != "group" or isinstance(value, bool)}
            return msgspec.convert(decoded | _numbers(channel, decoded, remark or _ignore), channel.payload)
        if issubclass(channel.payload, p.Switch) and isinstance(decoded, dict):
            action, stops = decoded.get("action"), decoded.get("enabled") is False
            stop = channel.payload(action=action if isinstance(action, str) else None, enabled=False if stops else None)
            if stop.ends():  # whatever else is wrong in it
                return stop
        raise PayloadError(f"{channel.metric}: {error}") from None


def plain(channel: Channel, raw: bytes) -> Any:
    """Return the JSON value in ``raw``, of any shape. Raises PayloadError if it is invalid or beyond the limits."""
    if channel.kind.direction == INCOMING and len(raw) > MAX_COMMAND_BYTES:
        raise PayloadError(f"{channel.metric}: {len(raw)} bytes, more than {MAX_COMMAND_BYTES}")
    text = trim(raw)
    try:
        text.decode()  # msgspec checks only the strings it keeps
        return _decoder.decode(text)
    except UnicodeDecodeError:
        raise PayloadError(f"{channel.metric}: not UTF-8: send UTF-8") from None
    except RecursionError:
        raise PayloadError(f"{channel.metric}: nested too deep") from None
    except msgspec.DecodeError as error:
        if b"\0" in raw.strip(_AROUND):
            raise PayloadError(f"{channel.metric}: not JSON before its NUL: if it is UTF-16, send UTF-8") from None
        raise PayloadError(f"{channel.metric}: not JSON: {error}") from None


def trim(raw: bytes) -> bytes:
    """Return the JSON in ``raw``: without a byte order mark, white space around it, or anything after a NUL.

    If there is nothing to remove, the same object is returned. A C program may send its whole buffer, with old content
    after the NUL. Firmware does the same (firmware/common/payload.py).
    """
    return raw.lstrip(_AROUND).partition(b"\0")[0].rstrip(_AROUND)


def _stop(channel: Channel, raw: bytes) -> p.EstopCommand:
    """Return the stop in ``raw``, nameless if it cannot be read. Raises PayloadError only for an empty payload."""
    if not raw:
        raise PayloadError(f"{channel.metric}: empty")
    try:
        body = plain(channel, raw)
    except PayloadError:
        return p.EstopCommand()
    name, by, why = stop_of(body)
    owner = fields(body).get("owner")
    return p.EstopCommand(stop=name or UNSET, by=by, why=why, owner=owner if isinstance(owner, str) else UNSET)


def is_blank(raw: bytes) -> bool:
    """True if ``raw`` is only white space: bridges publish such payloads to find cycles, and programs ignore them."""
    return bool(raw) and raw.isspace()


def _boolean(channel: Channel, control: Any) -> bool:
    if isinstance(control, bool):
        return control
    if isinstance(control, dict):
        for key in ("value", "enabled"):
            if isinstance(control.get(key), bool):
                return bool(control[key])
    raise PayloadError(f'{channel.metric}: only true, false, {{"value": bool}} or {{"enabled": bool}} switch it')


def _ignore(_channel: Channel, _sender: str, _text: str) -> None:
    """Do nothing, for a caller that wants no remarks."""


def _unwrap(channel: Channel, command: Any, remark: Remark) -> Any:
    """Return the fields of a command: the object under ``value`` if there is one, else the root (paper A.4.5)."""
    if channel.payload in (p.SoundboardCommand, p.AutonomyCommand):
        return _switch(command)
    if channel.payload is p.MediaRequest:
        return _request(channel, command)
    if not isinstance(command, dict):
        raise PayloadError(f"{channel.metric}: an object is needed, not {_name_of(command)}")
    inner = command["value"] if isinstance(command.get("value"), dict) else command
    return _drive(channel, inner, remark) if channel.payload is p.Drive else inner


def _switch(command: Any) -> Any:
    """Return the fields of a start or stop command: it may be a boolean or an object, bare or under ``value``."""
    if isinstance(command, bool):
        return {"enabled": command}
    if isinstance(command, dict):
        value = command.get("value")
        if isinstance(value, bool):
            return {**command, "enabled": value}
        if isinstance(value, dict):
            outer = {key: command[key] for key in ("file", "config", "repeat") if key in command}  # beside ``value``
            return {**outer, **value}
    return command


def _request(channel: Channel, request: Any) -> Any:
    """Return the fields of a media request, always with ``enabled``: a bare ``true`` is ``{"enabled": true}``."""
    inner = request["value"] if isinstance(request, dict) and isinstance(request.get("value"), dict) else request
    given = inner if isinstance(inner, dict) else {}
    return {**given, "enabled": _boolean(channel, inner)}


def _drive(channel: Channel, command: dict[str, Any], remark: Remark) -> dict[str, Any]:
    """Return a drive command's valid fields. Raises PayloadError if it moves and a field of _DRIVE_RULES is wrong."""
    axes = _numbers(channel, command, remark)
    if not axes:
        keys = ", ".join([_shown(key) for key in command][:_KEYS_SHOWN]) or "nothing"
        expected = 'expected {"x": steering, "z": throttle}, each -1 to 1'
        remark(channel, _sender(command), f"none of x, z and y is in it, but {keys}: so it is a stop; {expected}")
    moves = any(axes.values())
    given = {key: command[key] for key in _DRIVE_RULES if command.get(key) is not None}
    wrong = [key for key, value in given.items() if not _DRIVE_RULES[key].fits(value)]
    if moves and wrong:
        raise PayloadError(f"{channel.metric}: {wrong[0]} is not {_DRIVE_RULES[wrong[0]].expected}")
    if moves and given.get("source") == p.SCRIPT and "run" not in given:
        raise PayloadError(f"{channel.metric}: run is missing, which a script's command needs")
    if moves and "valid_ms" in given and given["valid_ms"] < 1:
        raise PayloadError(f"{channel.metric}: valid_ms is less than 1, so it moves nothing")
    valid = {key: value for key, value in given.items() if key not in wrong}  # a zero passes without wrong ones
    if "valid_ms" in valid:
        valid["valid_ms"] = int(valid["valid_ms"])
    others = {key: command[key] for key, fits in _OTHER_DRIVE_FIELDS.items() if fits(command.get(key))}
    return axes | valid | others


class _Rule(NamedTuple):
    """A rule for the value of a field, and what it expects, in words."""

    fits: Callable[[Any], bool]
    expected: str


#: Fields of a drive command besides its axes; null is the same as absent.
_DRIVE_RULES: dict[str, _Rule] = {
    "source": _Rule(lambda value: isinstance(value, str), "a string"),
    "key": _Rule(lambda value: isinstance(value, str), "a string"),
    "run": _Rule(lambda value: type(value) is int and 1 <= value <= p.LAST_RUN, f"an integer from 1 to {p.LAST_RUN}"),
    "valid_ms": _Rule(
        lambda value: type(value) in (int, float) and 0 <= value < _LONGEST_MS, "a number of milliseconds"
    ),
}
#: Its other fields, each with its rule; a wrong value is the same as absent, because none of them decides about motion.
_OTHER_DRIVE_FIELDS: dict[str, Callable[[Any], bool]] = {
    "t": lambda value: type(value) is int and 0 <= value <= p.LARGEST_MS,
    "by": lambda value: isinstance(value, str),
    "group": lambda value: isinstance(value, bool),
}


#: The numbers in a command, by its payload type, each with the value that it has if it cannot be read.
_NUMBERS: dict[Any, dict[str, float]] = {
    p.Drive: {"x": 0.0, "z": 0.0, "y": 0.0},
    p.LightsSolid: {"b": 0.0, "g": 0.0, "r": 0.0},
    p.LightsFlash: {"b": 0.0, "g": 0.0, "r": 0.0, "period": p.LightsFlash().period},
}


def _numbers(channel: Channel, command: dict[str, Any], remark: Remark) -> dict[str, float]:
    """Return the numbers in a command, also those written as text. A value that is no number becomes its default.

    The original reads commands in the same way. Raises PayloadError for NaN and infinity.
    """
    numbers = {}
    for name, default in _NUMBERS[channel.payload].items():
        if name in command:
            number = _number(channel, name, command[name])
            numbers[name] = default if number is None else number
            if number is None and command[name] is not None:  # null is no mistake: it means the default
                text = f"{name} is {_shown(command[name])}, which is no number: it counts as {default:g}"
                remark(channel, _sender(command), text)
    return numbers


def _number(channel: Channel, name: str, value: Any) -> float | None:
    """Return ``value``, a number or its text, as a number; else None. Raises PayloadError for NaN and infinity."""
    if isinstance(value, str):
        if "nan" in value.lower() or "inf" in value.lower():
            raise PayloadError(f"{channel.metric}: {name} is not a finite number")
        if not _numeric(value):
            return None
    elif isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise PayloadError(f"{channel.metric}: {name} is not a finite number")
    return number


def _sender(command: dict[str, Any]) -> str:
    source = command.get("source")
    return source if isinstance(source, str) else ""


def _shown(value: Any) -> str:
    return ascii(value[:_SHOWN]) if isinstance(value, str) else _name_of(value)


def _name_of(value: Any) -> str:
    names = {dict: "an object", list: "an array", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")
