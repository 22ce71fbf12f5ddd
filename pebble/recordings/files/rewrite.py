"""Copies recordings: what can be read of a damaged one, in larger chunks, or without some of the messages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pebble.recordings.files import mcap
from pebble.recordings.files.channels import ChannelTable
from pebble.recordings.files.mcap import FILE_TOPIC, Recorded
from pebble.recordings.files.reader import DAMAGE, MISSING, RecordingError, mapped, metadata_of, read
from pebble.recordings.files.scan import Damage
from pebble.recordings.files.writer import LIBRARY, McapWriter

REWRITTEN: Final = "pebble.rewritten"

Keeps = Callable[[Recorded], bool]


@dataclass(frozen=True, slots=True)
class Rewritten:
    """What a copy holds."""

    messages: int
    left_out: int
    missing: int  # messages that damage has taken
    size: int


def rewrite(source: Path, target: Path, *, keeps: Keeps = lambda _message: True, whole: bool = False) -> Rewritten:
    """Write the messages of ``source`` to ``target``, which may be the same file.

    ``whole``: refuse a file that cannot be read completely. Raises RecordingError, OSError.
    """
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    damage, left_out = Damage(), 0
    before = source.stat()
    try:
        with mapped(source) as data, part.open("xb", buffering=0) as file:
            writer = McapWriter(file, library=LIBRARY)
            about = metadata_of(data)
            for name, items in about.items():
                if name not in (DAMAGE, REWRITTEN):
                    writer.metadata(name, items)
            copy = Copy(writer)
            for message in read(data, damage):
                if keeps(message):
                    copy.add(message)
                else:
                    left_out += 1
            if whole and (damage.spans or damage.torn):
                raise RecordingError(f"{source}: is damaged; `pebble recordings recover` copies what can be read")
            missing = damage.missing + mcap.number_in(about.get(REWRITTEN, {}), MISSING)
            numbers = {"left_out": left_out, MISSING: missing}
            writer.metadata(REWRITTEN, {name: str(value) for name, value in numbers.items()})
            writer.finish()
            os.fsync(file.fileno())
            made = Rewritten(writer.contents.messages, left_out, missing, writer.size)
        if not os.path.samestat(before, source.stat()):
            raise RecordingError(f"{source}: was changed meanwhile")
        shutil.copystat(source, part)  # its age and who may read it
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    return made


class Copy:
    """Adds messages of any recordings to a file."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer, self._channels = writer, ChannelTable(writer)

    def add(self, message: Recorded) -> None:
        channel = message.channel
        if channel.topic == FILE_TOPIC:
            return
        key = (channel.topic, channel.encoding, tuple(sorted(channel.metadata.items())))
        number = self._channels.find(key)
        if number is None:
            number = self._channels.declare(key, channel.topic, channel.encoding, channel.metadata)
        if number is None:
            self._channels.add_other(
                channel.topic, channel.metadata, message.log_ns, message.payload, message.publish_ns
            )
        else:
            self._writer.add(number, message.log_ns, message.payload, message.publish_ns)
