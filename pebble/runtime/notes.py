"""Notes from a process to its launcher: one JSON object in a line, such as ``{"note":"ready"}``."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

OFTEN = 3  # starts within a minute: a program or board that starts so often is not well

_Name: TypeAlias = Annotated[str, Meta(min_length=1, max_length=64)]
_Why: TypeAlias = Annotated[str, Meta(max_length=200)]


class Ready(Struct, frozen=True, tag_field="note", tag="ready"):
    """A note that the process has started to work."""


class Alive(Struct, frozen=True, tag_field="note", tag="alive"):
    """A sign of life, sent every second."""


class Wanted(Struct, frozen=True, tag_field="note", tag="wanted"):
    """A request to run an on-demand program, which begins with ``encoding`` (empty: as configured), or to end it."""

    program: _Name
    on: bool
    encoding: Annotated[str, Meta(pattern=r"^[a-z0-9]{0,16}$(?!\n)")] = ""


class Held(Struct, frozen=True, tag_field="note", tag="held"):
    """A request to end an on-demand program for a while (``on``), or to let it run again if it is still wanted."""

    program: _Name
    on: bool


class Feature(Struct, frozen=True, tag_field="note", tag="feature"):
    """A note that the process has or lacks a feature of pebble.launcher.features; the capabilities list it."""

    name: Annotated[str, Meta(pattern=r"^(estop|control|outlets/[^/]{1,64}/(status|power))$(?!\n)")]
    has: bool


class Local(Struct, frozen=True, tag_field="note", tag="local"):
    """The state of the connection to the robot's other processes."""

    connected: bool
    why: _Why = ""


class Mcu(Struct, frozen=True, tag_field="note", tag="mcu"):
    """The state of a serial line. ``silent``: a board that normally sends all the time has stopped sending."""

    state: Literal["absent", "booting", "ready", "silent"]
    silent_ms: Literal[0, 1000, 10000] | None  # at least so long ago the board sent; None: never since opening
    why: _Why = ""  # of an absent board, or one that was never heard
    starts: Annotated[int, Meta(ge=0)] = 0  # further starts of the board within the last minute


class Reach(Struct, frozen=True, tag_field="note", tag="reach"):
    """A note that messages of a motor owner arrive in this process, or do not."""

    owner: _Name
    reached: bool


Note: TypeAlias = Ready | Alive | Wanted | Held | Feature | Local | Mcu | Reach

encode = msgspec.json.Encoder().encode
#: Return the note in a line. Raises msgspec.DecodeError.
decode = msgspec.json.Decoder(Note).decode
