"""Files that this process has made, and that others may remove or replace."""

import os
from pathlib import Path


class OwnFile:
    """A file that this process has made, such as a lock or a saved state."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._made = identity(path)

    @property
    def in_place(self) -> bool:
        """True if this process's file is still at its path."""
        return self._made is not None and identity(self._path) == self._made

    @property
    def replaced(self) -> bool:
        """True if another file has taken the place of this file."""
        return identity(self._path) not in (None, self._made)


def identity(file: Path | int) -> tuple[int, int] | None:
    """Return the numbers that identify an existing file; None if it does not exist."""
    try:
        status = os.stat(file)  # noqa: PTH116 - of a descriptor as well
    except (FileNotFoundError, NotADirectoryError):
        return None
    return status.st_dev, status.st_ino
