"""Root in folders of other users: it becomes the owner, so that a link there leads to what the owner could reach."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from pebble.errors import PebbleError
from pebble.runtime.whole_file import is_root


@contextmanager
def as_owner(folder: Path, *modules: str) -> Iterator[None]:
    """Do what follows as the owner of a folder, or of the first above it that exists; without being root, as before.

    ``modules`` are imported first: that user may not be able to read them. Raises PebbleError for a link.
    """
    place = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), folder)
    found = os.lstat(place)
    if stat.S_ISLNK(found.st_mode):
        raise PebbleError(f"{place} is a link: name the folder itself")
    if not is_root() or found.st_uid == 0:
        yield
        return
    for name in modules:
        import_module(name)
    groups = os.getgroups()
    os.setgroups([found.st_gid])
    os.setegid(found.st_gid)
    os.seteuid(found.st_uid)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(os.getgid())
        os.setgroups(groups)


@contextmanager
def as_before() -> Iterator[None]:
    """Be root again for a moment, inside of :func:`as_owner`."""
    owner = os.geteuid() if hasattr(os, "getresuid") and os.getresuid()[2] == 0 else None
    if owner is not None:
        os.seteuid(0)
    try:
        yield
    finally:
        if owner is not None:
            os.seteuid(owner)
