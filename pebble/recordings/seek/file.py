"""One recording that is read in any place: where its chunks are, and which channels each holds."""

import os
import tempfile
from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from pebble.errors import PebbleError
from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import (
    HEAD,
    MESSAGE,
    Channel,
    ChunkIndex,
    DamageError,
    Op,
    Recorded,
    RecordingError,
    Statistics,
    UnreadableError,
)
from pebble.recordings.files.reader import mapped
from pebble.recordings.files.rewrite import rewrite
from pebble.recordings.files.scan import begins_as_ours
from pebble.recordings.library import ACTIVE, robot_of
from pebble.recordings.recorder.lane import CARRIED

_CACHED: Final = 4  # chunks that stay unpacked: the next question is mostly about the same time
_SCANNED: Final = (Op.HEADER, Op.METADATA, Op.CHUNK, Op.MESSAGE_INDEX, Op.PADDING, Op.ATTACHMENT)
_INDEXES: Final = 64 << 10  # bytes that are read at once behind a chunk
_LARGEST_COPY: Final = 128 << 20  # bytes of a file that is copied to be read


class Chunk(NamedTuple):
    """Where a chunk is; ``channels`` empty: not known, so it may hold any."""

    start_ns: int
    end_ns: int
    at: int
    length: int  # with its head
    channels: frozenset[int]


class RecordingFile:
    """One file, finished or being written. Not thread-safe."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError."""
        self.path = path
        self.problem = ""  # what could not be read of it
        self._is_copied = False
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        self.channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._indexes: list[bytes] = []
        self._unpacked: OrderedDict[int, list[Recorded]] = OrderedDict()
        self._scanned: list[Chunk] = []
        self._end = len(mcap.MAGIC)  # of what was scanned
        self._about = os.fstat(self._descriptor)
        try:
            if not path.name.endswith(ACTIVE):
                self._read_finished()
            self.refresh()
        except (PebbleError, OSError):
            self.close()
            raise

    def close(self) -> None:
        os.close(self._descriptor)

    @property
    def is_finished(self) -> bool:
        return self._statistics is not None

    @property
    def first_ns(self) -> int:
        """0: it holds no message."""
        if self._statistics is not None:
            return self._statistics.first_ns
        return self._scanned[0].start_ns if self._scanned else 0

    @property
    def last_ns(self) -> int:
        if self._statistics is not None:
            return self._statistics.last_ns
        return max((chunk.end_ns for chunk in self._scanned), default=0)

    @property
    def chunks(self) -> list[Chunk]:
        """The messages in the order of time."""
        return self._scanned if self._statistics is None else self._chunks

    def size(self) -> int:
        """The size of the file itself, also where a copy is read."""
        return self.path.stat().st_size if self._is_copied else os.fstat(self._descriptor).st_size

    def robots(self) -> set[str]:
        """All that a channel with messages belongs to."""
        return {robot for channel in self.channels.values() if (robot := robot_of(channel)) is not None}

    def channels_of(self, robot: str) -> frozenset[int]:
        """Those of a robot, and the one of topics that have no channel of their own."""
        return frozenset(
            number
            for number, channel in self.channels.items()
            if robot_of(channel) == robot or channel.topic == mcap.OTHER
        )

    def is_replaced(self) -> bool:
        """Whether its name leads to another file now: it was compacted, or cleaned. Raises OSError."""
        now, then = self.path.stat(), self._about
        grown = not self.path.name.endswith(ACTIVE) and now.st_size != then.st_size
        return grown or not os.path.samestat(now, then)

    def refresh(self) -> None:
        """Find the chunks that were written since; one that is finished does not change."""
        while self._statistics is None and self._scan_chunk():
            pass

    def messages(self, chunk: Chunk) -> list[Recorded]:
        """Those of a chunk; empty if it is damaged."""
        known = self._unpacked.get(chunk.at)
        if known is None:
            known = self._unpacked[chunk.at] = list(self._read(chunk))
            if len(self._unpacked) > _CACHED:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(chunk.at)
        return known

    # -- finished files

    def _read_finished(self) -> None:
        """One of another program, or whose summary is damaged, is read from a copy, in which all is in its order."""
        with mapped(self.path) as data:
            summary = mcap.summary_of(data) if begins_as_ours(data) else None
        if summary is not None:
            self._read_summary(summary)
        if self._statistics is not None:
            return
        if self.size() > _LARGEST_COPY:
            why = (
                "another program wrote it, or its end is damaged: pebble recordings recover makes a copy for this page"
            )
            raise UnreadableError(f"{self.path}: {why}")
        with tempfile.TemporaryDirectory(prefix="pebble-recording-") as folder:
            copy = Path(folder, self.path.name)
            self.problem, self._is_copied = rewrite(self.path, copy).unread, True
            os.close(self._descriptor)
            self._descriptor = os.open(copy, os.O_RDONLY | os.O_CLOEXEC)
            with mapped(copy) as data:
                self._read_summary(mcap.summary_of(data))

    def _read_summary(self, found: tuple[int, bytes] | None) -> None:
        try:
            for op, begin, end in () if found is None else mcap.records(found[1]):
                self._take_over(op, found[1][begin:end] if found else b"")
        except DamageError:
            self._statistics = None

    def _take_over(self, op: int, body: bytes) -> None:
        if op == Op.CHANNEL:
            channel = Channel.unpack(body)
            self.channels[channel.id] = channel
        elif op == Op.CHUNK_INDEX:
            self._indexes.append(body)
        elif op == Op.STATISTICS:
            self._statistics = Statistics.unpack(body)

    @cached_property
    def _chunks(self) -> list[Chunk]:
        found = (ChunkIndex.unpack(body) for body in self._indexes)
        chunks = [
            Chunk(one.start_ns, one.end_ns, one.at, one.length, frozenset(one.indexes)) for one in found if one.indexes
        ]
        self._indexes = []
        return sorted(chunks)

    # -- files that are being written, or whose summary is damaged

    def _scan_chunk(self) -> bool:
        """Take the next record, if all of it is there; False at the end, and at what is none."""
        head = self._pread(HEAD.size, self._end)
        if len(head) < HEAD.size:
            return False
        op, length = HEAD.unpack(head)
        end = self._end + HEAD.size + length
        if op not in _SCANNED or end > self.size():
            return False
        if op == Op.CHUNK:
            self._add(self._end, HEAD.size + length)
        self._end = end
        return True

    def _add(self, at: int, length: int) -> None:
        start_ns, end_ns, _, _ = mcap.CHUNK.unpack(self._pread(mcap.CHUNK.size, at + HEAD.size))
        channels = self._indexed(at + length)
        chunk = Chunk(start_ns, end_ns, at, length, channels)
        if start_ns:
            self._scanned.append(chunk)
        if not channels <= self.channels.keys() or not channels:
            self._declare(chunk)

    def _indexed(self, at: int) -> frozenset[int]:
        """The channels of a chunk by the indexes behind it; empty if they are not all there."""
        data, place = self._pread(_INDEXES, at), 0
        found: set[int] = set()
        while place + HEAD.size + 2 <= len(data):
            op, length = HEAD.unpack_from(data, place)
            if op != Op.MESSAGE_INDEX:
                return frozenset(found)
            found.add(int.from_bytes(data[place + HEAD.size : place + HEAD.size + 2], "little"))
            place += HEAD.size + length
        return frozenset()

    def _declare(self, chunk: Chunk) -> None:
        try:
            records = self._unpack(chunk)
            for op, begin, end in mcap.records(records):
                if op == Op.CHANNEL:
                    channel = Channel.unpack(records[begin:end])
                    self.channels[channel.id] = channel
        except DamageError:
            return

    # -- both

    def _read(self, chunk: Chunk) -> Iterator[Recorded]:
        try:
            records = self._unpack(chunk)
            for op, begin, end in mcap.records(records):
                if op == Op.CHANNEL:
                    declared = Channel.unpack(records[begin:end])
                    self.channels.setdefault(declared.id, declared)
                elif op == Op.MESSAGE:
                    number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(records, begin)
                    channel, payload = self.channels.get(number), records[begin + MESSAGE.size : end]
                    if channel is not None and channel.topic == mcap.OTHER:
                        channel, payload = mcap.unpack_other(channel, payload)
                    if channel is not None:
                        yield Recorded(channel, sequence, log_ns, publish_ns, payload)
        except DamageError as error:
            self.problem = self.problem or f"a part of it is damaged ({error})"

    def _unpack(self, chunk: Chunk) -> bytes:
        return mcap.unpack_chunk(self._pread(chunk.length - HEAD.size, chunk.at + HEAD.size))

    def _pread(self, size: int, at: int) -> bytes:
        return os.pread(self._descriptor, size, at)


def is_carried(channel: Channel) -> bool:
    """Whether its messages were written again at the begin of the file, and are not of that time."""
    return channel.metadata.get("retained") == CARRIED
