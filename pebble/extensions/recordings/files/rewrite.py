"""Copies of recordings: the readable part of a damaged or unfinished one, or all but some of its messages."""

import errno
import os
import shutil
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pebble.extensions.recordings.files.reader import DAMAGE, MISSING, RecordingFile, missing_before
from pebble.extensions.recordings.files.recorded import Channel, Recorded, RecordingError, Schema
from pebble.extensions.recordings.files.writer import MOST_CHANNELS, File, RecordingWriter
from pebble.runtime.whole_file import set_mode, sync_file

PART: Final = ".part"  # the end of a copy's name while it is written

Keeps = Callable[[Recorded], bool]


@dataclass(frozen=True, slots=True)
class Rewritten:
    """The contents of a copy."""

    messages: int
    left_out: int
    missing: int  # messages that damage has taken
    unread: str  # what could not be read, in words; "" if all was
    is_whole: bool  # the source held nothing more than the begin of a record that a kill has cut off


def rewrite(source: Path, target: Path, *, keeps: Keeps = lambda _message: True) -> Rewritten:
    """Write the messages of ``source`` to ``target``, in the order of time; both may be the same file.

    A file is only replaced by a complete copy of what ``keeps`` accepts: it stays as it is if it could not be read
    completely, if the copy cannot be read again, or if nothing is left out. Raises RecordingError, OSError.
    """
    in_place = source == target
    part = target.with_name(f".{target.name}.{os.getpid()}{PART}")
    if not in_place and target.exists():
        raise RecordingError(f"{target} exists already")
    try:
        copy = _copy(source, part, keeps, complete=in_place)
        if in_place and not copy.left_out:
            return copy
        _check(part, copy)
        status = source.stat()
        set_mode(part, stat.S_IMODE(status.st_mode))
        with suppress(OSError):  # some shares let only the owner set times
            os.utime(part, ns=(status.st_atime_ns, status.st_mtime_ns))
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    return copy


class Copy:
    """A writer that adds messages of other recordings to a file."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._channels: dict[tuple[object, ...], int] = {}  # their numbers in the file, by all that makes them differ
        self._schemas: dict[Schema, int] = {}  # their numbers in the file

    def add(self, message: Recorded) -> None:
        channel = message.channel
        key = (channel.topic, channel.encoding, tuple(channel.metadata.items()), channel.schema)
        number = self._channels.get(key)
        if number is None:
            number = self._channels[key] = self._declare(channel)
        self._writer.add(number, message.log_ns, message.payload, message.publish_ns)

    def _declare(self, channel: Channel) -> int:
        """Add a channel to the file, with its schema if that is new; return its number there."""
        if self._writer.channels == MOST_CHANNELS:
            raise RecordingError(f"{channel.topic}: one file has no room for more topics: choose a shorter time")
        schema, number = channel.schema, 0
        if schema is not None:
            number = self._schemas.get(schema, 0)
            if not number:
                number = self._schemas[schema] = self._writer.schema(schema.name, schema.encoding, schema.data)
        return self._writer.channel(channel.topic, channel.encoding, channel.metadata, number)


def write_copy(messages: Iterable[Recorded], out: File) -> int:
    """Write ``messages`` as a recording; return their number."""
    writer = RecordingWriter(out)
    writer.metadata("pebble.recording", {"format": "1", "exported": "1"})
    copy = Copy(writer)
    for message in messages:
        copy.add(message)
    writer.finish()
    return writer.messages


def _copy(source: Path, part: Path, keeps: Keeps, *, complete: bool) -> Rewritten:
    """Write the copy. Raises OSError, and RecordingError if it must be ``complete`` and is not."""
    room = shutil.disk_usage(part.parent)
    if room.total and room.free < source.stat().st_size:  # some shares tell no sizes
        raise OSError(errno.ENOSPC, f"there is no room for a copy of {source.name}", str(part.parent))
    left_out = 0
    with RecordingFile(source) as file, part.open("xb", buffering=0) as out:
        metadata, writer = file.metadata(), RecordingWriter(out)
        for name, items in metadata.items():
            if name != DAMAGE:
                writer.metadata(name, items)
        copy = Copy(writer)
        for message in file.read():
            if keeps(message):
                copy.add(message)
            else:
                left_out += 1
        damage, ends_as_after_kill = file.damage, file.is_cut_off
        if complete:
            _refuse_part(file)
        missing = damage.missing + missing_before(metadata)
        if missing or damage.parts:
            writer.metadata(DAMAGE, {MISSING: str(missing)})
        writer.finish()
        sync_file(out.fileno())
    # Behind the last record a kill leaves nothing, zeros or part of a record. Other bytes there could not be read.
    lacks_something = damage.parts or damage.missing or damage.unnamed
    is_whole = ends_as_after_kill and not lacks_something
    return Rewritten(writer.messages, left_out, missing, damage.report(), is_whole)


def _refuse_part(file: RecordingFile) -> None:
    """Raise RecordingError if a file may hold more than could be read."""
    if text := file.damage.report():
        raise RecordingError(f"{file.path}: {text}; `pebble recordings mend` copies what can be read")
    if not file.is_ours:
        raise RecordingError(f"{file.path}: another program wrote it, and what only that knows would be lost")


def _check(part: Path, copy: Rewritten) -> None:
    """Read a copy once more before it replaces the source. Raises RecordingError."""
    with RecordingFile(part) as file:
        messages = sum(len(file.messages(chunk)) for chunk in file.chunks)
        if messages != copy.messages or file.damage.report():
            raise RecordingError(f"{part.name}: cannot be read again ({file.damage.report() or 'other messages'})")
