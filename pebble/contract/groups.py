"""Groups: several commands in one message on ``incoming/group``; all are carried out, or none. Pure.

    {"drive-values": {"x": -0.3, "z": 0.7, "valid_ms": 400}, "lights-solid": {"r": 0.2, "g": 0.7, "b": 1}}

The keys are metrics, the members bare objects. Stops, resets, flags, control, scripts and media are not allowed. Where
names are checked, ``by`` is the sender of the group, and counts instead of any ``by`` in the members.
"""

import math
from typing import Any

import msgspec
from msgspec import Struct

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.names import BY
from pebble.errors import PayloadError

MOST_MEMBERS, MOST_BYTES = 8, 2048  # of a group: one packet of a thin link, and one write at a board
MEMBERS = (c.DRIVE, c.LIGHTS_SOLID, c.LIGHTS_FLASH, c.SOUNDBOARD_COMMAND, c.OUTLET_COMMAND, c.MCU_COMMAND)
_SHOWN = 40  # characters of a metric
MARK = "group"  # a field of a member's copy for programs that take no groups: true


class Member(Struct, frozen=True):
    """A command of a group: its channel, metric, decoded value and JSON."""

    channel: c.Channel
    metric: str
    value: Any
    payload: bytes


def decode(raw: bytes) -> tuple[Member, ...]:
    """Return the members of a group. Raises PayloadError if a member is not allowed, or cannot be read."""
    if len(raw) > MOST_BYTES:
        raise PayloadError(f"{c.GROUP.metric}: {len(raw)} bytes, more than {MOST_BYTES}")
    codec.plain(c.GROUP, raw)  # for its errors alone: no JSON, or beyond the limits of all commands
    commands = _strict_json(codec.trim(raw))
    by = commands.pop(BY, None) if isinstance(commands, dict) else None
    if not isinstance(commands, dict) or not 1 <= len(commands) <= MOST_MEMBERS:
        raise PayloadError(f"{c.GROUP.metric}: an object of 1 to {MOST_MEMBERS} commands is needed")
    if {c.LIGHTS_SOLID.metric, c.LIGHTS_FLASH.metric} <= commands.keys():
        raise PayloadError(f"{c.GROUP.metric}: {c.LIGHTS_SOLID.metric} and {c.LIGHTS_FLASH.metric} exclude one another")
    return tuple(_member(metric, command, by) for metric, command in commands.items())


def _member(metric: str, command: Any, by: Any) -> Member:
    channel = c.channel_of(f"{c.INCOMING}/{metric}")
    if channel not in MEMBERS:
        raise PayloadError(f"{c.GROUP.metric}: {metric[:_SHOWN]!a} may not be in a group")
    if not isinstance(command, dict) or isinstance(command.get("value"), dict):
        raise PayloadError(f"{c.GROUP.metric}: {metric}: a bare object is needed")
    command.pop(MARK, None)  # no sender may set it: only the bridge marks, and only copies
    if by is not None:
        command[BY] = by
    try:
        payload = msgspec.json.encode(command)
    except OverflowError:
        raise PayloadError(f"{c.GROUP.metric}: {metric}: a number is too large") from None
    return Member(channel, metric, codec.decode(channel, payload), payload)


def _strict_json(text: bytes) -> Any:
    """Return the JSON value in ``text``. Raises PayloadError for an infinite number, or a key twice in any spelling."""
    import json  # no other reader shows a key that is there twice; only robots with groups pay for it

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        fields = dict(pairs)
        if len(fields) < len(pairs):
            raise PayloadError(f"{c.GROUP.metric}: a key is there twice")
        return fields

    def finite(number: str) -> float:
        value = float(number)
        if not math.isfinite(value):
            raise PayloadError(f"{c.GROUP.metric}: {number[:_SHOWN]} is not a finite number")
        return value

    return json.loads(text, object_pairs_hook=unique, parse_float=finite)
