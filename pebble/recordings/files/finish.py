"""Finishes in place what a killed recorder has left: no copy is made, so it works on a full disk.

A torn end is cut off, if it is the begin of one record or zeros, and the summary is written. Damaged bytes, also at the
end, are covered by a record that every reader of MCAP skips: of them only the first nine change, unless they held the
names of channels. These are written there again, because readers from the begin to the end refuse a message whose
channel comes later.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec

from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import (
    FILE_TOPIC,
    HEAD,
    MESSAGE,
    Channel,
    ChunkIndex,
    DamageError,
    Metadata,
    Op,
    Packer,
    RecordingError,
    Schema,
    UnreadableError,
)
from pebble.recordings.files.reader import DAMAGE, MISSING, Summary, mapped, unnamed
from pebble.recordings.files.reading_lock import own
from pebble.recordings.files.scan import Block, Damage, blocks, is_cut_off, is_of_others
from pebble.recordings.files.writer import Contents

_TORN, _DAMAGED = "torn_bytes", "damaged_bytes"
CANNOT_BE_READ: Final = 3  # exit code
_LIBRARY: Final = "pebble"
READERS_S: Final = 5.0  # that finishing waits for readers


@dataclass(frozen=True, slots=True)
class Finished:
    """What a file holds now."""

    messages: int
    missing: int  # by their numbers; a torn end may have held more
    damaged_bytes: int
    torn_bytes: int

    @property
    def whole(self) -> bool:
        return not (self.missing or self.damaged_bytes or self.torn_bytes)


def finish(path: Path) -> Finished:
    """Make ``path`` a finished file. May be interrupted at any moment, and called again.

    Raises RecordingError, also for a file of another program; OSError, also while it is being read.
    """
    with path.open("r+b", buffering=0) as file:
        finished = _finish(file, path)
        os.fsync(file.fileno())
        return finished


def main(arguments: list[str]) -> int:
    """``python -m pebble.recordings.files.finish PATH``: prints what the file holds now, as JSON."""
    try:
        made = finish(Path(arguments[0]))
    except UnreadableError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except (RecordingError, DamageError) as error:
        sys.stderr.write(f"{error}\n")
        return CANNOT_BE_READ
    except (OSError, IndexError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.buffer.write(msgspec.json.encode(made))
    return 0


def _finish(file: BinaryIO, path: Path) -> Finished:
    damage, contents = Damage(), _Contents()
    with mapped(path) as data:
        if is_of_others(data):
            raise RecordingError(f"{path}: another program wrote it: `pebble recordings recover` makes a finished copy")
        for block in blocks(data, damage):
            contents.add(block, data)
        if not contents.end_at:
            raise RecordingError(f"{path}: nothing in it can be read")
        if damage.torn and not is_cut_off(data, len(data) - damage.torn):
            damage.spans.append((len(data) - damage.torn, len(data)))
            contents.end_at = len(data)
        contents.complete(Summary.of(data))
        covers = _joined(contents.wrong + damage.spans)
        damaged = max(contents.covered, contents.damaged_before) + sum(end - begin for begin, end in covers)
        torn = contents.torn + (0 if damage.finished else len(data) - contents.end_at)
    finished = Finished(contents.messages, contents.missing, damaged, torn)
    if damage.finished and not covers:
        return finished
    own(file, path, READERS_S)
    rest = contents.mend_indexes(file, covers)
    _cover(file, covers, contents)
    file.truncate(contents.end_at)
    file.seek(contents.end_at)
    _write(file, rest)
    contents.end_at += len(rest)
    if not finished.whole:
        numbers = {MISSING: finished.missing, _DAMAGED: damaged, _TORN: torn}
        about = Metadata(DAMAGE, {name: str(number) for name, number in numbers.items()})
        contents.metadata.append((about, contents.end_at))
        _write(file, about.pack())
        contents.end_at += len(about.pack())
    _write(file, contents.end(contents.end_at, len(contents.chunks), b"".join(contents.chunks)))
    return finished


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Sorted, those that touch each other as one: where an index became the begin of a chunk, only both have room."""
    joined: list[tuple[int, int]] = []
    for begin, end in sorted(spans):
        if joined and joined[-1][1] == begin:
            begin = joined.pop()[0]
        joined.append((begin, end))
    return joined


def _cover(file: BinaryIO, spans: list[tuple[int, int]], contents: _Contents) -> None:
    for begin, end in spans:
        start = b"" if begin else mcap.header(_LIBRARY, contents.file)
        room = end - begin - len(start) - HEAD.size
        if room < 0:
            raise RecordingError(f"{end - begin} damaged bytes are too few to be covered")
        names = contents.name_channels(begin + len(start), end, room)
        file.seek(begin)
        _write(file, start + names + HEAD.pack(Op.PADDING, room - len(names)))


def _write(file: BinaryIO, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


class _Contents(Contents):
    """What was found in a file."""

    def __init__(self) -> None:
        super().__init__()
        self.chunks: list[bytes] = []  # their indexes, packed
        self.file = ""  # its name, which its chunks repeat
        self.end_at = 0  # where the data end that can be kept
        self.missing = 0  # messages, by their numbers
        self.wrong: list[tuple[int, int]] = []  # indexes that say something else than their chunk
        self.covered = self.damaged_before = self.torn = 0  # bytes, when the file was finished before
        self._mends: list[tuple[int, int, bytes]] = []  # number of a chunk, where its indexes belong, and what they are
        self._early: dict[int, int] = {}  # channels that are used before they are named: where the first chunk is
        self._due = self._missed_before = 0

    def add(self, block: Block, data: Any) -> None:
        if block.op is Op.METADATA:
            metadata = Metadata.unpack(block.body)
            if metadata.name == DAMAGE:  # written again behind the data
                self.torn = mcap.number_in(metadata.items, _TORN)
                self._missed_before = mcap.number_in(metadata.items, MISSING)
                self.damaged_before = mcap.number_in(metadata.items, _DAMAGED)
                return
            self.metadata.append((metadata, block.at))
        elif block.op is Op.ATTACHMENT:
            self.attachments.append(mcap.attachment_index(data[block.at : block.end], block.at))
        elif block.op is Op.PADDING:
            self.covered += block.end - block.at
        elif block.op is Op.CHUNK:
            self.file = self.file or mcap.file_of_chunk(block.body)
            self._add_chunk(block, data)
        self.end_at = block.end

    def complete(self, summary: Summary | None) -> None:
        """Take over what only the summary knows, if there is one."""
        if summary is not None:
            self.channels = {**summary.channels, **self.channels}
            before = summary.statistics.messages + self._missed_before
            self.missing = max(self.missing, before - self.messages)  # the last ones may be missing, too
        for number in self.counts.keys() - self.channels.keys():
            self.channels[number] = unnamed(number)

    def mend_indexes(self, file: BinaryIO, covers: list[tuple[int, int]]) -> bytes:
        """Write the indexes of chunks anew, in place of damaged bytes in ``covers``; returns those of the last chunk.

        Where bytes are lost they have no room: readers by index do not see such a chunk, all others do.
        """
        for number, at, indexes in self._mends:
            place = next((place for place, span in enumerate(covers) if span[0] == at), None)
            room = 0 if place is None else covers[place][1] - at - len(indexes)
            if place is not None and (room == 0 or room >= HEAD.size):
                file.seek(at)
                _write(file, indexes)
                covers[place : place + 1] = [(at + len(indexes), covers[place][1])] if room else []
            elif at == self.end_at:
                return indexes
            elif place is not None and covers[place][1] == self.end_at:
                del covers[place]
                self.end_at = at
                return indexes
            else:
                index = ChunkIndex.unpack(self.chunks[number][HEAD.size :])
                self.chunks[number] = replace(index, start_ns=0, end_ns=0, indexes={}, indexes_length=0).pack()
        return b""

    def name_channels(self, at: int, end: int, room: int) -> bytes:
        """A chunk for ``at`` with the channels that chunks behind ``end`` use too early; none if it has no ``room``."""
        early = [self.channels[number] for number, where in self._early.items() if where >= end]
        if not early:
            return b""
        schemas = [self.schemas[number].pack() for number in {one.schema for one in early} & self.schemas.keys()]
        first = [one for one in self.channels.values() if one.topic == FILE_TOPIC]  # as in each chunk
        records = b"".join([one.pack() for one in first] + schemas + [one.pack() for one in early])
        chunk = mcap.chunk(records, 0, 0, Packer())
        if len(chunk) > room:
            return b""
        for one in early:
            del self._early[one.id]
        compression, packed = mcap.chunk_compression(chunk[HEAD.size :])
        index = ChunkIndex(0, 0, at, len(chunk), {}, 0, compression, packed, len(records))
        self.chunks.append(index.pack())
        self.chunks.sort(key=lambda packed: ChunkIndex.unpack(packed[HEAD.size :]).at)
        return chunk

    def _add_chunk(self, block: Block, data: Any) -> None:
        entries = self._entries(block.body, block.at)
        times = [log_ns for each in entries.values() for log_ns, _ in each]
        expected, indexes = b"", {}
        for channel, each in entries.items():
            indexes[channel] = block.record_end + len(expected)
            expected += mcap.message_index(channel, each)
        if data[block.record_end : block.end] != expected:
            self._mends.append((len(self.chunks), block.record_end, expected))
            if block.end > block.record_end:
                self.wrong.append((block.record_end, block.end))
        compression, packed = mcap.chunk_compression(data[block.at + HEAD.size : block.record_end])
        self.chunks.append(
            ChunkIndex(
                min(times, default=0),
                max(times, default=0),
                block.at,
                block.record_end - block.at,
                indexes,
                len(expected),
                compression,
                packed,
                len(block.body),
            ).pack()
        )

    def _entries(self, records: bytes, at: int) -> dict[int, list[tuple[int, int]]]:
        """The indexes that belong to the records of the chunk at ``at``."""
        entries: dict[int, list[tuple[int, int]]] = {}
        for op, begin, stop in mcap.records(records):
            if op == Op.MESSAGE:
                channel, sequence, log_ns, _ = MESSAGE.unpack_from(records, begin)
                entries.setdefault(channel, []).append((log_ns, begin - HEAD.size))
                if channel not in self.channels:
                    self._early.setdefault(channel, at)
                self.count(channel, log_ns)
                self.missing += max(0, sequence - self._due)
                self._due = sequence + 1
            elif op == Op.CHANNEL:
                one = Channel.unpack(records[begin:stop])
                self.channels.setdefault(one.id, one)
            elif op == Op.SCHEMA:
                schema = Schema.unpack(records[begin:stop])
                self.schemas.setdefault(schema.id, schema)
        return entries


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
