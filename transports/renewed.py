"""Values made from files that may be replaced while this process runs: certificates, keys, passwords."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Generic, TypeVar

from pebble.errors import TransportError

log = logging.getLogger(__name__)

_T = TypeVar("_T")


class Renewed(Generic[_T]):
    """A value that is made again, at its next use, if its files have changed.

    If the files cannot be used, because they are half written or gone, that is logged once, and the last good value
    stays. ``first`` is the value if the files were read already; otherwise it is made now, and errors are raised.
    """

    def __init__(self, files: Iterable[Path], make: Callable[[], _T], first: _T | None = None) -> None:
        self._files = list(files)
        self._make = make
        self._made_from = self._versions()  # before they are read: a change while they are read counts as a later one
        self._value = make() if first is None else first
        self._problem = ""

    def get(self) -> _T:
        versions = self._versions()
        if versions == self._made_from:
            return self._value
        try:
            self._value = self._make()
        except (OSError, ValueError, TransportError) as error:
            if str(error) != self._problem:
                self._problem = str(error)
                log.warning("%s; what was there before is used until this is mended", error)
        else:
            self._made_from, self._problem = versions, ""
            log.info("read again, because of changes: %s", ", ".join(map(str, self._files)))
        return self._value

    def _versions(self) -> list[tuple[int, ...]]:
        return [_version(file) for file in self._files]


def _version(file: Path) -> tuple[int, ...]:
    """Return numbers that change whenever the file is written, replaced, removed, or given to another user."""
    try:
        status = file.stat()
    except OSError:
        return ()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
