"""Copies recordings: what can be read of a damaged one, in larger chunks, or without some of the messages."""

import os
import shutil
from collections.abc import Callable, Container
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pebble.recordings.files import mcap
from pebble.recordings.files.channels import ChannelTable
from pebble.recordings.files.mcap import Metadata, Op, Recorded, RecordingError
from pebble.recordings.files.reader import DAMAGE, MISSING, mapped, metadata_of, read
from pebble.recordings.files.scan import Damage, blocks
from pebble.recordings.files.writer import LIBRARY, McapWriter

REWRITTEN: Final = "pebble.rewritten"
_PLAIN: Final = frozenset({"", "json", "application/octet-stream"})  # what the shared channel may hold
PART: Final = ".part"  # the end of a copy's name while it is written

Keeps = Callable[[Recorded], bool]


@dataclass(frozen=True, slots=True)
class Rewritten:
    """What a copy holds."""

    messages: int
    left_out: int
    missing: int  # messages that damage has taken
    size: int
    unread: str  # what could not be read, in words; "" if all was
    is_empty: bool  # neither messages nor attachments are in it


def rewrite(source: Path, target: Path, *, keeps: Keeps | None = None) -> Rewritten:
    """Write the messages of ``source`` to ``target``, in the order of time; both may be the same file.

    A file is only replaced by a copy of all that is in it that ``keeps`` accepts: it stays as it is if not all could be
    read, if the copy cannot be read again, and if nothing is left out. Raises RecordingError, OSError.
    """
    in_place = target.exists()
    part = target.with_name(f".{target.name}.{os.getpid()}{PART}")
    damage, left_out = Damage(), 0
    before = _state(source)
    if in_place and not os.path.samestat(source.stat(), target.stat()):
        raise RecordingError(f"{target} exists already")
    try:
        with mapped(source) as data, part.open("xb", buffering=0) as file:
            writer = McapWriter(file, library=LIBRARY)
            copy_beside(data, writer)
            copy = Copy(writer)
            for message in read(data, damage):
                if keeps is None or keeps(message):
                    copy.add(message)
                else:
                    left_out += 1
            if in_place and damage.unread:
                raise RecordingError(f"{source}: {_why(damage)}")
            missing = damage.missing + mcap.number_in(metadata_of(data).get(REWRITTEN, {}), MISSING)
            numbers = {"left_out": left_out, MISSING: missing}
            writer.metadata(REWRITTEN, {name: str(value) for name, value in numbers.items()})
            writer.finish()
            os.fsync(file.fileno())
        contents = writer.contents
        is_empty = not (contents.messages or contents.attachments)
        made = Rewritten(contents.messages, left_out, missing, writer.size, damage.report(), is_empty)
        if in_place and keeps is not None and not left_out:
            return made
        _check(part, made)
        if _state(source) != before:
            raise RecordingError(f"{source}: was changed meanwhile")
        if target.exists() != in_place:
            raise RecordingError(f"{target}: was changed meanwhile")
        shutil.copystat(source, part)  # its age and who may read it
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    return made


def copy_beside(data: Any, writer: McapWriter, without: Container[str] = (DAMAGE, REWRITTEN)) -> None:
    """Add the metadata and attachments of a file, without metadata of some names."""
    for block in blocks(data, Damage()):
        if block.op is Op.METADATA:
            metadata = Metadata.unpack(block.body)
            if metadata.name not in without:
                writer.metadata(metadata.name, metadata.items)
        elif block.op is Op.ATTACHMENT:
            writer.attach(data[block.at : block.end])


def _state(path: Path) -> tuple[int, ...]:
    """What differs if a file is replaced or written to."""
    about = path.stat()
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns


def _why(damage: Damage) -> str:
    if text := damage.report():
        return f"{text}; `pebble recordings recover` copies what can be read"
    if damage.covered:
        return f"{damage.covered:,} damaged bytes were covered when it was finished, and would be lost"
    return f"{damage.private:,} records in it are known only to the program that wrote it, and would be lost"


def _check(part: Path, made: Rewritten) -> None:
    """Read a copy again before it replaces anything. Raises RecordingError."""
    damage = Damage()
    with mapped(part) as data:
        messages = sum(1 for _ in read(data, damage))
    if messages != made.messages or damage.spans or damage.torn or damage.unended:
        raise RecordingError(f"{part.name}: cannot be read again ({damage.report() or 'other messages'})")


class Copy:
    """Adds messages of any recordings to a file."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer, self._channels = writer, ChannelTable(writer)

    def add(self, message: Recorded) -> None:
        channel = message.channel
        schema = channel.described
        key = (channel.topic, channel.encoding, tuple(sorted(channel.metadata.items())), schema)
        number = self._channels.find(key)
        if number is None:
            number = self._channels.declare(key, channel.topic, channel.encoding, channel.metadata, schema)
        if number is None:
            if schema is not None or channel.encoding not in _PLAIN:
                raise RecordingError(f"{channel.topic}: there is no room for more topics that are not JSON or bytes")
            self._channels.add_other(
                channel.topic, channel.metadata, message.log_ns, message.payload, message.publish_ns
            )
        else:
            self._writer.add(number, message.log_ns, message.payload, message.publish_ns)
