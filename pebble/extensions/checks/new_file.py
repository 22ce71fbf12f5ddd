"""Files such as reports and backups, created so that only their owner can read them."""

import os
from pathlib import Path

from pebble.errors import PebbleError
from pebble.ownership import owner_of
from pebble.runtime.whole_file import is_root, sync_file, sync_folder


def why_taken(file: Path, suffix: str) -> str:
    """Return why no new file with this name can be written; empty if it can. ``suffix``: that of such files."""
    if not file.exists():
        return ""
    if file.suffix == suffix:
        return f"{file} exists: name another file, or remove it"
    return f"{file} would be overwritten, and is no {suffix} file: name a new one"


def write_new(file: Path, content: bytes) -> None:
    """Write a new file that only its owner can read. Raises PebbleError, as root also as :func:`owner_of`."""
    if is_root():
        owner_of(file)
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600)
    except OSError as error:
        raise PebbleError(f"{file}: cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as output:
            if os.fstat(descriptor).st_mode & 0o077:
                why = "others can read every file on its file system: name one on another, or mount it umask=077"
                raise PebbleError(f"{file}: {why}")
            output.write(content)
            output.flush()
            sync_file(descriptor)
        sync_folder(file.parent)
    except BaseException as error:
        file.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PebbleError(f"{file}: {error.strerror}") from None
        raise
