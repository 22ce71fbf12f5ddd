"""Root in folders of other users: it becomes the owner, so that a link there leads to what the owner could reach."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path

from pebble.errors import PebbleError
from pebble.ownership import Owner, owner_of
from pebble.runtime.whole_file import is_root


@contextmanager
def as_owner(folder: Path, *modules: str, make: bool = False) -> Iterator[None]:
    """Do what follows as the owner of a folder, or of the first above it that exists; without being root, as before.

    For commands, whose process has one thread. ``modules`` are imported first: that user may not be able to read them.
    ``make``: the folder, if it is missing. Raises PebbleError as :func:`owner_of`.
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
    with _as_user(owner):
        yield


@contextmanager
def as_before() -> Iterator[None]:
    """Be root again for a moment, inside of :func:`as_owner`."""
    if hasattr(os, "getresuid") and os.getresuid()[2] == 0 != os.geteuid():
        with _as_user(Owner(0, os.getgid())):
            yield
    else:
        yield


def require_own(folder: Path) -> None:
    """Raise PebbleError for root in a folder of another user, where a program runs for long, or with threads."""
    if is_root() and (uid := owner_of(folder, nameless=False).uid):
        raise PebbleError(
            f"{folder} belongs to user {uid}, so root does not write there: run it as that user, or name another folder"
        )


@contextmanager
def _as_user(owner: Owner) -> Iterator[None]:
    """Take the rights of a user, and only these, for a while."""
    before, groups = Owner(os.geteuid(), os.getegid()), os.getgroups()
    _take(owner, _groups_of(owner))
    try:
        yield
    finally:
        _take(before, groups)


def _take(owner: Owner, groups: list[int]) -> None:
    os.seteuid(0)
    os.setgroups(groups)
    os.setegid(owner.gid)
    os.seteuid(owner.uid)


def _groups_of(owner: Owner) -> list[int]:
    import pwd  # which Windows lacks

    with suppress(KeyError):  # a user without an entry has no other groups
        user = pwd.getpwuid(owner.uid)
        return os.getgrouplist(user.pw_name, owner.gid)
    return [owner.gid]
