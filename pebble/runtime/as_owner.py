"""Lets root work in another user's folder with that user's rights only, so that a link there opens nothing else."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from pebble.errors import PebbleError
from pebble.ownership import Owner, as_user, is_open, owner_of
from pebble.runtime.whole_file import is_root


@contextmanager
def as_owner(folder: Path, *modules: str, make: bool = False) -> Iterator[None]:
    """Run the ``with`` block as the owner of ``folder``, or of its nearest existing parent, if this process is root.

    For commands, whose process has one thread. ``modules`` are imported first: that user may not be able to read them.
    ``make``: create the folder if it is missing. Raises PebbleError as :func:`owner_of`.
    """
    if make:
        try:
            with as_owner(folder):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # another user may be faster
        except OSError as error:
            raise PebbleError(f"{folder}: {error.strerror}") from None
    owner = owner_of(folder) if is_root() else None
    if owner is None or owner.uid == 0:
        yield
        return
    for name in modules:
        import_module(name)
    with as_user(owner):
        yield


@contextmanager
def as_before() -> Iterator[None]:
    """Be root again in the ``with`` block, inside of :func:`as_owner`."""
    was_root = hasattr(os, "getresuid") and os.getresuid()[2] == 0  # by its saved user id
    if was_root and os.geteuid() != 0:
        with as_user(Owner(0, os.getgid())):
            yield
    else:
        yield


def require_own(folder: Path, does: str = "does not write there", *, there: bool = False) -> None:
    """Raise PebbleError if this process is root and the folder belongs to another user, or to all, as /tmp does.

    For programs with threads, or that use the folder for long. ``folder`` may be a file; with ``there`` it has to
    exist. ``does`` completes the error: "root does not …".
    """
    if not is_root():
        return
    owner = owner_of(folder, nameless=False, there=there)  # users without a name, as in containers, do not count
    if owner.uid or is_open(folder):
        who = f"user {owner.uid}" if owner.uid else "all users"
        raise PebbleError(f"{folder} belongs to {who}, so root {does}: run it as that user, or name another folder")
