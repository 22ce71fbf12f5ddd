"""Files for people that hold what is private: written once, and never readable by others."""

import os
from pathlib import Path

from pebble.errors import PebbleError


def write_new(file: Path, content: bytes) -> None:
    """Write a file that was not there before, whole or not at all. Raises PebbleError."""
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        raise PebbleError(f"{file} exists: name another file, or remove it") from None
    except OSError as error:
        raise PebbleError(f"{file}: cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as output:
            if os.fstat(descriptor).st_mode & 0o077:
                raise PebbleError(
                    f"{file}: others can read every file on its file system: name one on another, or mount it umask=077"
                )
            output.write(content)
            output.flush()
            os.fsync(descriptor)
    except BaseException as error:
        file.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PebbleError(f"{file}: cannot be written: {error.strerror}") from None
        raise
