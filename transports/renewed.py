"""What is made from files that others replace while this process runs: certificates, keys, passwords."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Generic, TypeVar

from pebble.errors import TransportError

log = logging.getLogger(__name__)

_T = TypeVar("_T")


class Renewed(Generic[_T]):
    """A value that is made again, when it is used, from files that have changed since.

    Files that cannot be used, because they are half written or gone, are reported once; until they can, the last good
    value stays. ``first`` is the value if the files were read already; else the first one is made now, with its errors.
    """

    def __init__(self, files: Iterable[Path], make: Callable[[], _T], first: _T | None = None) -> None:
        self._files = list(files)
        self._make = make
        self._made_from = self._versions()  # before they are read: what is written meanwhile differs again
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
    """Differs whenever the file has been written, replaced, removed or given to others."""
    try:
        found = file.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
