"""The contents of a recording: channels, messages and damage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import msgspec

from pebble.errors import PebbleError

SUFFIX: Final = ".mcap"  # of a file that is finished
ACTIVE: Final = ".mcap.active"  # is being written, or was left by a recorder that was killed
#: The topic of messages whose channel is not named anywhere in a damaged file, before its number.
UNNAMED: Final = "$recorder/unnamed/"
FOREVER_NS: Final = 1 << 64  # after all times that a file can hold


class RecordingError(PebbleError):
    """An error: a file cannot be read as a recording. Example: ``walk.mcap: No such file or directory``."""


class DamageError(PebbleError):
    """An error: bytes are not the record that they should be. Example: ``a chunk's checksum is wrong``."""


@dataclass(frozen=True, slots=True)
class Schema:
    """The description of a channel's messages, such as a set of Protobuf descriptors."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic and the common properties of its messages; several channels may have the same topic."""

    id: int
    topic: str
    encoding: str  # of its messages: json, protobuf, application/octet-stream
    metadata: Mapping[str, str] = field(default_factory=dict)
    schema: Schema | None = None


class Recorded(msgspec.Struct, frozen=True):
    """A message of a recording."""

    channel: Channel
    sequence: int  # its number in the file, from 0
    log_ns: int  # when it was received, since 1970
    publish_ns: int  # its own stamp; 0: it has none
    payload: bytes


@dataclass(slots=True)
class Damage:
    """The damage found in the parts of a file that were read."""

    parts: set[int] = field(default_factory=set)  # where chunks are damaged, and where bytes between records begin
    missing: int = 0  # messages; those at a torn end are not known
    unnamed: int = 0  # messages whose channel is not named anywhere
    torn: int = 0  # bytes at the end that are no whole record
    finished: bool = False  # the file ends with a summary
    why: str = ""  # the first reason

    def add(self, at: int, why: object, messages: int = 0) -> None:
        """Note a damaged part once, with its number of messages."""
        if at not in self.parts:
            self.parts.add(at)
            self.missing += messages
            self.why = self.why or str(why)

    def report(self, *, active: bool = False) -> str:
        """Return the damage in words; "" if there is none.

        ``active``: the file is known to be written now, so it needs no end. Any other without an end may be, too.
        """
        reasons = [
            (len(self.parts), f"damaged parts: {len(self.parts):,}"),
            (self.missing, f"messages missing: {self.missing:,}"),
            (self.unnamed, f"messages without a topic: {self.unnamed:,}"),
            (self.torn and not active, f"{self.torn:,} bytes at its end cannot be read"),
            (not (self.finished or active), "its end is missing or damaged, or it is being written"),
        ]
        text = ", ".join(words for is_there, words in reasons if is_there)
        return f"{text} ({self.why})" if text and self.why else text


def finished_path(path: Path) -> Path:
    """Return the path that a ``.mcap.active`` file has once it is finished."""
    return path.with_name(path.name.removesuffix(ACTIVE) + SUFFIX)


def present_path(path: Path) -> Path | None:
    """Return the path of a listed file now: a recorder may have finished it, or deleted it (None)."""
    if path.name.endswith(ACTIVE) and not path.exists():
        path = finished_path(path)
    return path if path.exists() else None


def require_package() -> None:
    """Raise RecordingError if the package ``mcap`` is not installed."""
    if find_spec("mcap") is None:
        raise RecordingError('recordings need the package mcap: pip install "pebble-robot[record]"')
