"""What a process notifies its launcher of: one JSON object in a line, such as ``{"note":"ready"}``."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

OFTEN = 3  # starts within a minute with which nothing that moves or senses is well, whatever it does in between

_Name: TypeAlias = Annotated[str, Meta(min_length=1, max_length=64)]
_Why: TypeAlias = Annotated[str, Meta(max_length=200)]


class Ready(Struct, frozen=True, tag_field="note", tag="ready"):
    """The process works from now on."""


class Alive(Struct, frozen=True, tag_field="note", tag="alive"):
    """The process lives; it says so every second."""


class Wanted(Struct, frozen=True, tag_field="note", tag="wanted"):
    """An on-demand program is to run, beginning with ``encoding`` (empty: as configured), or no longer."""

    program: _Name
    on: bool
    encoding: Annotated[str, Meta(pattern=r"^[a-z0-9]{0,16}$(?!\n)")] = ""


class Held(Struct, frozen=True, tag_field="note", tag="held"):
    """An on-demand program is to wait, or no longer."""

    program: _Name
    on: bool


class Feature(Struct, frozen=True, tag_field="note", tag="feature"):
    """The process has, or lacks, what the capabilities list: pebble.launcher.features."""

    name: Annotated[str, Meta(pattern=r"^(estop|control|outlets/[^/]{1,64}/(status|power))$(?!\n)")]
    has: bool


class Local(Struct, frozen=True, tag_field="note", tag="local"):
    """The process is connected to its siblings, or not, and why."""

    connected: bool
    why: _Why = ""


class Mcu(Struct, frozen=True, tag_field="note", tag="mcu"):
    """The state of a serial line. ``silent``: its board used to send all the time, and has stopped."""

    state: Literal["absent", "booting", "ready", "silent"]
    silent_ms: Literal[0, 1000, 10000] | None  # how long ago its board sent, at least; None: never since opening
    why: _Why = ""  # it is absent, or was never heard
    starts: Annotated[int, Meta(ge=0)] = 0  # how often the board has started again within the last minute


class Reach(Struct, frozen=True, tag_field="note", tag="reach"):
    """What a motor owner publishes arrives in the process, or not."""

    owner: _Name
    reached: bool


Note: TypeAlias = Ready | Alive | Wanted | Held | Feature | Local | Mcu | Reach

encode = msgspec.json.Encoder().encode
#: Returns the note in a line. Raises msgspec.DecodeError.
decode = msgspec.json.Decoder(Note).decode
