"""Lanes: series of files, one for the state of all robots, and one for the pictures and sound of each."""

import os
import re
from collections.abc import Mapping
from typing import BinaryIO, Final, NamedTuple

from pebble.extensions.recordings.files.recorded import finished_path
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.recorder.folder import MEDIA, STATE, Folder, rename
from pebble.extensions.recordings.stamps import stamp_ns
from pebble.runtime.whole_file import sync_file

#: Of a retained value that is written again at the begin of a file.
CARRIED: Final = "carried"
_DAY_NS: Final = 86_400 * 10**9
#: Of one file, so that many robots, or who invents topics, begin files more often. It begins with 10,000 at most.
_MOST_CHANNELS: Final = 20_000
_MOST_INDEXED: Final = 300_000  # channels of all its chunks: each takes 100 bytes of memory until it is finished
_JSON: Final = frozenset(b'{["-0123456789tfn')
OTHER_MEDIA: Final = f"{MEDIA}_other"
_PLAIN: Final = re.compile(r"[A-Za-z0-9_-]{1,32}").fullmatch


class Item(NamedTuple):
    """A message on its way into a file."""

    boot_ns: int  # when it was received, by a clock that is never set
    topic: str
    payload: bytes
    qos: int | None  # None: unknown
    retain: bool | None  # as published; None: unknown
    retained: str  # "1": an old value; "carried": written again at the begin of a file; "": neither
    source: str = ""  # the name of its connection, where there are several


class OpenFile:
    """A file that is being written."""

    def __init__(self, folder: Folder, lane: str, now_ns: int, about: Mapping[str, str]) -> None:
        self.file, self.path = folder.create(lane, now_ns)
        self.began_ns = now_ns
        self.last_ns = 0  # of its messages
        self.pending: list[Item] = []  # what the file has not taken yet
        try:
            self.writer = RecordingWriter(RawFile(self.file))
            self.writer.metadata("pebble.recording", {**about, "lane": lane})
        except OSError:
            self.discard()
            raise
        self._taken = 0  # written messages that :meth:`take_written` has returned
        self._channels: dict[tuple[object, ...], int] = {}  # their numbers in the file, by what their messages share

    @property
    def is_full(self) -> bool:
        """True if the next message must go into a new file."""
        return self.writer.channels >= _MOST_CHANNELS or self.writer.indexed >= _MOST_INDEXED

    def add(self, item: Item, at_ns: int) -> None:
        """Add a message. Times never go back within a file. Raises OSError."""
        if item.retained != CARRIED:  # carried: each new file is given the retained values anyway
            self.pending.append(item)
        self.last_ns = log_ns = max(self.last_ns, at_ns)
        stamp = stamp_ns(item.payload)
        # A stamp that is further off is none, or of a clock that is wrong.
        publish_ns = stamp if abs(stamp - log_ns) < _DAY_NS else 0
        key = (item.topic, item.qos, item.retain, item.retained, item.source, _is_json(item.payload))
        channel = self._channels.get(key)
        if channel is None:
            encoding = "json" if _is_json(item.payload) else "application/octet-stream"
            channel = self._channels[key] = self.writer.channel(item.topic, encoding, _metadata(item))
        self.writer.add(channel, log_ns, item.payload, publish_ns)

    def flush(self) -> int:
        """Write all that was added; return how many messages were written since the last call."""
        self.writer.flush()
        self.pending.clear()
        return self.take_written()

    def take_written(self) -> int:
        """Return how many messages were written since the last call."""
        since, self._taken = self._taken, self.writer.flushed
        return self._taken - since

    def take_lacking(self) -> list[Item]:
        """Return and forget, after an error, the messages that were not written."""
        lacking = self.writer.messages - self.writer.flushed
        items, self.pending = self.pending, []
        return items[max(0, len(items) - lacking) :] if lacking else []

    def finish(self) -> None:
        """Write the summary, make the file durable and give it its final name. Raises OSError."""
        try:
            self.writer.finish()
            sync_file(self.file.fileno())
            self.file.close()  # some file systems rename no open file
            rename(self.path, finished_path(self.path))
        finally:
            self.file.close()

    def discard(self) -> None:
        """Delete a file without messages."""
        self.file.close()
        self.path.unlink(missing_ok=True)

    def is_there(self) -> bool:
        """True if the file's name still leads to this file: its folder may have been removed."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self.file.fileno()))
        except OSError:
            return False


def lane_of(topic: str, *, is_media: bool) -> str:
    """Return the lane of a message.

    A robot's media have a lane of their own if its identity can be part of a file name; all others share one.
    """
    if not is_media:
        return STATE
    levels = topic.split("/", 3)[:3]
    plain = len(levels) == 3 and all(map(_PLAIN, levels))
    return f"{MEDIA}{'.'.join(levels)}" if plain else OTHER_MEDIA


class RawFile:
    """The unbuffered file as :class:`RecordingWriter` takes it: ``write`` is one system call."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, data: memoryview, /) -> int | None:
        return self._file.write(data)


def _metadata(item: Item) -> dict[str, str]:
    metadata = {} if item.qos is None else {"qos": str(item.qos)}
    if item.retain is not None:
        metadata["retain"] = str(int(item.retain))
    if item.retained:
        metadata["retained"] = item.retained
    if item.source:
        metadata["source"] = item.source
    return metadata


def _is_json(payload: bytes) -> bool:
    return bool(payload) and payload[0] in _JSON
