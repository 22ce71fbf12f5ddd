"""A recording that is read at any place. The chunks used last stay decompressed."""

import os
from collections import OrderedDict
from pathlib import Path
from typing import Final

from pebble.extensions.recordings.files.reader import OLD_OTHER, Chunk, RecordingFile
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from pebble.extensions.recordings.library import ACTIVE, robot_of
from pebble.extensions.recordings.recorder.lane import CARRIED

_CACHED: Final = 4  # chunks: the next question is mostly about the same time


class SeekableFile(RecordingFile):
    """A file, finished or still being written."""

    def __init__(self, path: Path) -> None:
        self._unpacked_chunks: OrderedDict[int, list[Recorded]] = OrderedDict()
        super().__init__(path)
        self._about = os.fstat(self._file.fileno())

    def robots(self) -> set[str]:
        """Return all robots that have a channel."""
        return {robot for channel in self.channels.values() if (robot := robot_of(channel)) is not None}

    def channels_of(self, robot: str) -> frozenset[int]:
        """Return a robot's channels and, in files of the last version, the common channel of other topics."""
        return frozenset(
            number
            for number, channel in self.channels.items()
            if robot_of(channel) == robot or channel.topic == OLD_OTHER
        )

    def is_replaced(self) -> bool:
        """True if the file's name leads to another file now. Raises OSError."""
        now, then = self.path.stat(), self._about
        grown = not self.path.name.endswith(ACTIVE) and now.st_size != then.st_size
        return grown or not os.path.samestat(now, then)

    def messages_of(self, chunk: Chunk) -> list[Recorded]:
        """Return the messages of a chunk in the order of time; empty if the chunk is damaged."""
        messages = self._unpacked_chunks.get(chunk.at)
        if messages is None:
            messages = self._unpacked_chunks[chunk.at] = self.messages(chunk)
            if len(self._unpacked_chunks) > _CACHED:
                self._unpacked_chunks.popitem(last=False)
        self._unpacked_chunks.move_to_end(chunk.at)
        return messages


def is_carried(channel: Channel) -> bool:
    """True if the message was copied to the beginning of the file, and is older than the file."""
    return channel.metadata.get("retained") == CARRIED
