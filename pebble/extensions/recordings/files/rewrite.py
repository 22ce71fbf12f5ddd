"""Copies of recordings: the readable part of a damaged or unfinished one, or all but some of its messages."""

import errno
import os
import shutil
import stat
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pebble.extensions.recordings.files.reader import DAMAGE, MISSING, OLD_COPY, RecordingFile, missing_before
from pebble.extensions.recordings.files.recorded import Channel, Recorded, RecordingError, Schema, number_in
from pebble.extensions.recordings.files.writer import MOST_CHANNELS, File, RecordingWriter
from pebble.runtime.whole_file import set_mode, sync_file

PART: Final = ".part"  # the end of a copy's name while it is written
_ABOUT: Final = "pebble.recording"  # metadata of each file that is not a copy
_COVERED: Final = "damaged_bytes"  # metadata of the last version: bytes that are left in a file, and not read

Keeps = Callable[[Recorded], bool]


@dataclass(frozen=True, slots=True)
class Rewritten:
    """The contents of a copy."""

    messages: int
    left_out: int
    missing: int  # messages that damage has taken
    unread: str  # what could not be read, in words; "" if all was
    is_whole: bool  # the source held nothing else, but the begin of a record that a kill has cut off
    is_empty: bool  # neither messages nor attachments are in it


def rewrite(source: Path, target: Path, *, keeps: Keeps = lambda _message: True) -> Rewritten:
    """Write the messages of ``source`` to ``target``, in the order of time; both may be the same file.

    A file is only replaced by a complete copy of what ``keeps`` accepts: it stays as it is if it could not be read
    completely, if the copy cannot be read again, or if nothing is left out. Raises RecordingError, OSError.
    """
    in_place = target.exists()
    part = target.with_name(f".{target.name}.{os.getpid()}{PART}")
    if in_place and not os.path.samestat(source.stat(), target.stat()):
        raise RecordingError(f"{target} exists already")
    before = _state(source)
    try:
        copy = _copy(source, part, keeps, complete=in_place)
        if in_place and not copy.left_out:
            return copy
        _check(part, copy)
        if _state(source) != before:
            raise RecordingError(f"{source}: was changed meanwhile")
        if target.exists() != in_place:
            raise RecordingError(f"{target}: was changed meanwhile")
        _copy_state(source, part)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    return copy


def _copy_state(source: Path, part: Path) -> None:
    """Give the copy the age of the source and, if the file system has them, its readers. Raises OSError."""
    try:
        shutil.copystat(source, part)
    except OSError:
        status = source.stat()
        set_mode(part, stat.S_IMODE(status.st_mode))
        os.utime(part, ns=(status.st_atime_ns, status.st_mtime_ns))


def copy_beside(source: RecordingFile, writer: RecordingWriter, without: Container[str] = (DAMAGE, OLD_COPY)) -> int:
    """Copy a file's metadata, except of some names, and its attachments; return the number of attachments."""
    from mcap.records import Attachment

    attachments = 0
    for record in source.beside():
        if isinstance(record, Attachment):
            times = {"log_ns": record.log_time, "create_ns": record.create_time}
            writer.attach(record.name, record.media_type, record.data, **times)
            attachments += 1
        elif record.name not in without:
            writer.metadata(record.name, record.metadata)
    return attachments


class Copy:
    """A writer that adds messages of other recordings to a file."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[Schema, int] = {}

    def add(self, message: Recorded) -> None:
        channel = message.channel
        key = (channel.topic, channel.encoding, tuple(channel.metadata.items()), channel.schema)
        number = self._channels.get(key)
        if number is None:
            number = self._channels[key] = self._declare(channel)
        self._writer.add(number, message.log_ns, message.payload, message.publish_ns)

    def _declare(self, channel: Channel) -> int:
        if self._writer.channels == MOST_CHANNELS:
            raise RecordingError(f"{channel.topic}: one file has no room for more topics: choose a shorter time")
        schema, number = channel.schema, 0
        if schema is not None:
            number = self._schemas.get(schema, 0)
            if not number:
                number = self._schemas[schema] = self._writer.schema(schema.name, schema.encoding, schema.data)
        return self._writer.channel(channel.topic, channel.encoding, channel.metadata, number)


def write_copy(
    messages: Iterable[Recorded], out: File, *, on_time: Callable[[int], None], beside: Iterable[Path] = ()
) -> int:
    """Write ``messages`` as a recording; return their number. ``on_time`` gets the time of each.

    ``beside``: files whose metadata and attachments are copied, after the last message.
    """
    writer = RecordingWriter(out)
    writer.metadata(_ABOUT, {"format": "1", "exported": "1"})
    copy = Copy(writer)
    for message in messages:
        copy.add(message)
        on_time(message.log_ns)
    for path in beside:
        if path.exists():  # not deleted meanwhile, to make room
            with RecordingFile(path) as file:
                copy_beside(file, writer, (_ABOUT, DAMAGE, OLD_COPY))
    writer.finish()
    return writer.messages


def _copy(source: Path, part: Path, keeps: Keeps, *, complete: bool) -> Rewritten:
    """Write the copy. Raises OSError, and RecordingError if it must be ``complete`` and is not."""
    if shutil.disk_usage(part.parent).free < source.stat().st_size:
        raise OSError(errno.ENOSPC, f"there is no room for a copy of {source.name}", str(part.parent))
    left_out = 0
    with RecordingFile(source) as file, part.open("xb", buffering=0) as out:
        metadata, writer = file.metadata(), RecordingWriter(out)
        attachments = copy_beside(file, writer)
        copy = Copy(writer)
        for message in file.read():
            if keeps(message):
                copy.add(message)
            else:
                left_out += 1
        damage, is_cut_off = file.damage, file.is_cut_off
        if complete:
            _refuse_part(file, metadata)
        missing = damage.missing + missing_before(metadata)
        if missing or damage.parts:
            writer.metadata(DAMAGE, {MISSING: str(missing)})
        writer.finish()
        sync_file(out.fileno())
    is_whole = not (damage.parts or damage.missing or damage.unnamed) and is_cut_off
    is_empty = not (writer.messages or attachments)
    return Rewritten(writer.messages, left_out, missing, damage.report(), is_whole, is_empty)


def _refuse_part(file: RecordingFile, metadata: dict[str, dict[str, str]]) -> None:
    """Raise RecordingError if a file may hold more than could be read."""
    if text := file.damage.report():
        raise RecordingError(f"{file.path}: {text}; `pebble recordings mend` copies what can be read")
    if covered := number_in(metadata.get(DAMAGE, {}), _COVERED):
        raise RecordingError(f"{file.path}: {covered:,} damaged bytes are left in it, and would be lost")
    if not file.is_ours:
        raise RecordingError(f"{file.path}: another program wrote it, and what only that knows would be lost")


def _state(path: Path) -> tuple[int, ...]:
    """Return a value that changes if the file is replaced or written to."""
    about = path.stat()
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns


def _check(part: Path, made: Rewritten) -> None:
    """Read a copy once more before it replaces the source. Raises RecordingError."""
    with RecordingFile(part) as file:
        messages = sum(len(file.messages(chunk)) for chunk in file.chunks)
        if messages != made.messages or file.damage.report():
            raise RecordingError(f"{part.name}: cannot be read again ({file.damage.report() or 'other messages'})")
