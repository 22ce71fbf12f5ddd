"""Exports a stretch as a recording of its own."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO, Final

from pebble.recordings.files.mcap import Recorded
from pebble.recordings.files.reader import DAMAGE, mapped
from pebble.recordings.files.rewrite import REWRITTEN, Copy, copy_beside
from pebble.recordings.files.writer import LIBRARY, McapWriter

_ABOUT: Final = "pebble.recording"


def write_copy(
    messages: Iterable[Recorded], out: BinaryIO, *, on_time: Callable[[int], None], beside: Iterable[Path] = ()
) -> int:
    """Write ``messages`` as MCAP; returns how many there were. ``on_time`` gets the time of each.

    ``beside``: files whose metadata and attachments go with them, as they are known after the last message.
    """
    writer = McapWriter(_Whole(out), library=LIBRARY)
    writer.metadata(_ABOUT, {"format": "1", "exported": "1"})
    copy = Copy(writer)
    for message in messages:
        copy.add(message)
        on_time(message.log_ns)
    for path in beside:
        if path.exists():  # not deleted meanwhile, to make room
            with mapped(path) as data:
                copy_beside(data, writer, (_ABOUT, DAMAGE, REWRITTEN))
    writer.finish()
    return writer.contents.messages


class _Whole:
    """A buffered file as a writer's sink."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, data: memoryview, /) -> int | None:
        return self._file.write(data)
