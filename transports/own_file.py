"""Whether a file that a process has made, or reads, is still the one at its path."""

import os
from pathlib import Path


class OwnFile:
    """A file that is this process's now: of a socket where it listens, or of memory that it shares."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._made = identity(path)

    @property
    def in_place(self) -> bool:
        """True if others that open its path still reach this process."""
        return self._made is not None and identity(self._path) == self._made

    @property
    def replaced(self) -> bool:
        """True if another file is at its path."""
        return identity(self._path) not in (None, self._made)


def identity(file: Path | int) -> tuple[int, int] | None:
    """Return what tells a file from one that has taken its place; None if there is none."""
    try:
        found = os.stat(file)  # noqa: PTH116 - of a descriptor as well
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_dev, found.st_ino
