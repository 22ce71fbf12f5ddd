"""Files for people that hold what is private: written once, and never readable by others."""

from pathlib import Path

from pebble.errors import PebbleError
from pebble.runtime import whole_file


def write_new(file: Path, content: bytes) -> None:
    """Write a file that was not there before, whole or not at all. Raises PebbleError."""
    try:
        file.touch(0o600, exist_ok=False)
    except OSError as error:
        raise PebbleError(f"{file}: cannot be written: {error.strerror}") from None
    try:
        if file.stat().st_mode & 0o077:
            why = "others can read every file on its file system: name one on another, or mount it umask=077"
            raise PebbleError(f"{file}: {why}")
        whole_file.write(file, content, 0o600, PebbleError)
    except BaseException:
        file.unlink(missing_ok=True)
        raise
