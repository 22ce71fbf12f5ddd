"""A file that is there when it is whole."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pebble.extensions.recordings.files.recorded import RecordingError
from pebble.runtime.as_owner import as_owner


@contextmanager
def unfinished(target: Path) -> Iterator[Path]:
    """Give a path beside ``target`` to write to: it becomes ``target`` at the end, and is removed after an error.

    Raises RecordingError if there is a file already, no folder, or no room.
    """
    if target.exists():
        raise RecordingError(f"{target} exists already")
    if not target.parent.is_dir():
        raise RecordingError(f"{target.parent}: there is no such folder")
    path = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with as_owner(target.parent):
            try:
                yield path
                if target.exists():
                    raise RecordingError(f"{target} exists already")
                path.replace(target)
            finally:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror or error}") from None
