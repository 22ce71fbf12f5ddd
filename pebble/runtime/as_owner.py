"""Root in folders of other users: it becomes the owner, so that a link there leads to what the owner could reach."""

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
    """Run the ``with`` block as the owner of a folder, or of its nearest parent that exists, if this process is root.

    For commands, whose process has one thread. ``modules`` are imported first: that user may not be able to read them.
    ``make``: create the folder if it is missing. Raises PebbleError as :func:`owner_of`.
    """
    if make:
        try:
            with as_owner(folder):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # another user may be faster
        except OSError as error:
            raise PebbleError(f"{folder}: {error.strerror}") from None
    if not is_root() or (owner := owner_of(folder)).uid == 0:
        yield
        return
    for name in modules:
        import_module(name)
    with as_user(owner):
        yield


@contextmanager
def as_before() -> Iterator[None]:
    """Be root again for a moment, inside of :func:`as_owner`."""
    if hasattr(os, "getresuid") and os.getresuid()[2] == 0 != os.geteuid():
        with as_user(Owner(0, os.getgid())):
            yield
    else:
        yield


def require_own(folder: Path, does: str = "does not write there", *, there: bool = False) -> None:
    """Raise PebbleError for root in a folder of another user, where a program runs for long, or with threads.

    The same in a folder where every user may make files, such as /tmp. It may be a file as well, and may have to be
    ``there``. ``does``: what root does not, then.
    """
    if not is_root():
        return
    owner = owner_of(folder, nameless=False, there=there)
    who = f"user {owner.uid}" if owner.uid else "all users" if is_open(folder) else ""
    if who:
        raise PebbleError(f"{folder} belongs to {who}, so root {does}: run it as that user, or name another folder")
