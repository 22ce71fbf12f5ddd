"""Exports a stretch as a recording of its own."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO, Final

from pebble.recordings.files.reader import DAMAGE, OLD_COPY, RecordingFile
from pebble.recordings.files.recorded import Recorded
from pebble.recordings.files.rewrite import Copy, copy_beside
from pebble.recordings.files.writer import RecordingWriter

_ABOUT: Final = "pebble.recording"


def write_copy(
    messages: Iterable[Recorded], out: BinaryIO, *, on_time: Callable[[int], None], beside: Iterable[Path] = ()
) -> int:
    """Write ``messages`` as MCAP; returns how many there were. ``on_time`` gets the time of each.

    ``beside``: files whose metadata and attachments go with them, as they are known after the last message.
    """
    writer = RecordingWriter(out)
    writer.metadata(_ABOUT, {"format": "1", "exported": "1"})
    Copy(writer).add_all(messages, on_time)
    for path in beside:
        if path.exists():  # not deleted meanwhile, to make room
            with RecordingFile(path) as file:
                copy_beside(file, writer, (_ABOUT, DAMAGE, OLD_COPY))
    writer.finish()
    return writer.messages
