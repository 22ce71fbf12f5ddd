"""A file that appears under its name only once it is complete."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pebble.extensions.recordings.files.recorded import RecordingError
from pebble.runtime.as_owner import as_owner


@contextmanager
def unfinished(target: Path) -> Iterator[Path]:
    """Yield a path beside ``target`` to write to; it is renamed to ``target`` at the end, removed after an error.

    Raises RecordingError if ``target`` exists, its folder does not, or the disk is full.
    """
    if target.exists():
        raise RecordingError(f"{target} exists already")
    if not target.parent.is_dir():
        raise RecordingError(f"{target.parent}: there is no such folder")
    try:  # in a folder of its own: in a shared one others could make this file first, or a link
        with as_owner(target.parent), TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
            path = Path(folder, target.name)
            yield path
            if target.exists():
                raise RecordingError(f"{target} exists already")
            path.replace(target)
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror or error}") from None
