"""Decides which users can replace a file or folder, and reads only what they cannot replace."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pebble.errors import PebbleError

SUBUIDS = Path("/etc/subuid")  # whom users may be in containers of theirs: NAME:FIRST:COUNT


class Owner(NamedTuple):
    """A user and a group, by their numbers."""

    uid: int
    gid: int


def owner_of(folder: Path, *, nameless: bool = True, there: bool = False) -> Owner:
    """Return the only user besides root who can change the content of ``folder``, or root if none can.

    ``folder`` may be a file. ``there``: it must exist. ``nameless``: users without an entry in the user database count,
    too; in a container they are those of the machine around it. Raises PebbleError if several users can, for a link on
    the way that a user besides root can change, and if ``folder`` must exist and does not.
    """
    place, owner = Path("/"), Owner(0, 0)
    root = place.lstat().st_uid  # in a user namespace root's files may seem to be of another user
    names = list(folder.absolute().parts[1:])
    while names:
        place /= names.pop(0)
        try:
            status = place.lstat()
        except OSError as error:  # it is missing, or not to be seen by this user
            if there:
                raise PebbleError(f"{place}: {error.strerror}") from None
            break  # then the owner of the folder above decides
        uid = status.st_uid
        if uid == root or not (nameless or _has_name(uid)):  # root, or a user who does not count
            uid = 0
        if stat.S_ISLNK(status.st_mode):
            if owner.uid or uid:
                raise PebbleError(f"{place} is a link of user {uid or owner.uid}: name the folder itself")
            if _leads_in_a_circle(place):
                raise PebbleError(f"{place} is a link that leads back to itself: remove it")
            target = place.readlink()
            if place.is_relative_to("/proc") and place.parent.name == "fd" and not target.is_absolute():
                return owner  # a pipe of this process's, which a shell has made: `pebble check <(jq … robot.json)`
            return owner_of(place.parent.joinpath(target, *names), nameless=nameless, there=there)
        if owner.uid not in (0, uid):
            raise PebbleError(f"{place} belongs to user {uid}, and lies in a folder of user {owner.uid}: move it")
        if uid == 0 and _is_shared(place, status):
            raise PebbleError(f"{place} belongs to root, and others may write there: chmod go-w it, or chown it")
        owner = Owner(uid, status.st_gid)
    return owner


def _leads_in_a_circle(link: Path) -> bool:
    try:
        link.stat()
    except OSError as error:  # it leads nowhere, or this user may not see where
        return error.errno == errno.ELOOP
    return False


def others_in(folder: Path) -> str:
    """Return why a user other than this one and root may change the content of ``folder``; empty if none may."""
    try:
        uid = owner_of(folder).uid
    except PebbleError as error:
        return str(error)
    return f"{folder} belongs to user {uid}" if uid and os.geteuid() not in (0, uid) else ""


def _has_name(uid: int) -> bool:
    """True if the user has an entry in the user database, or is a user of a container by /etc/subuid."""
    import pwd  # which Windows lacks

    with suppress(KeyError):
        return bool(pwd.getpwuid(uid))
    with suppress(OSError, ValueError):
        ranges = [line.split(":")[1:] for line in SUBUIDS.read_text(encoding="utf-8").splitlines()]
        return any(int(first) <= uid < int(first) + int(count) for first, count in ranges)
    return False


def _is_shared(place: Path, status: os.stat_result) -> bool:
    """True if users other than the owner can replace files in this folder, or change this file."""
    mode = status.st_mode
    if not stat.S_ISREG(mode) and (not stat.S_ISDIR(mode) or mode & stat.S_ISVTX):  # there only owners remove files
        return False
    return bool(mode & stat.S_IWOTH or (mode & stat.S_IWGRP and (status.st_gid or _has_access_list(place))))


def _has_access_list(place: Path) -> bool:
    """True if an access control list names users; the bits of the group are then the most that they may do."""
    with suppress(AttributeError, OSError):  # a system or a file system that has no lists
        return "system.posix_acl_access" in os.listxattr(place)
    return False


def is_open(folder: Path) -> bool:
    """True if every user may make files in the folder, but not remove those of others, as in /tmp."""
    try:
        status = folder.stat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and bool(status.st_mode & stat.S_IWOTH)


def open_plain(file: Path) -> BinaryIO:
    """Open a plain file to read it. Raises OSError, also for a FIFO or a device, which might never end."""
    opened = open(file, "rb", opener=lambda path, flags: os.open(path, flags | getattr(os, "O_NONBLOCK", 0)))  # noqa: SIM115
    if stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
        return opened
    opened.close()
    raise OSError(errno.EINVAL, "is no plain file", str(file))


def read_plain(file: Path, most: int = 1 << 28) -> bytes:
    """Return the content of a plain file. Raises OSError, also if it is larger than ``most`` bytes."""
    with open_plain(file) as opened:
        if os.fstat(opened.fileno()).st_size > most:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(file))
        return opened.read(most)


def read_for(place: Path, file: Path) -> bytes:
    """Return the content of a plain file that ``place`` names; as root, only what the owner of ``place`` may read.

    Raises OSError, and PebbleError as :func:`owner_of`.
    """
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        owner = owner_of(place, nameless=False, there=True)  # of users with a name; it must exist
        if owner.uid:
            with as_user(owner):
                return read_plain(file)
    return read_plain(file)


@contextmanager
def as_user(owner: Owner) -> Iterator[None]:
    """Take the rights of a user, and only these, in the ``with`` block. For a process of root with one thread."""
    before, groups = Owner(os.geteuid(), os.getegid()), os.getgroups()
    _take(*_rights_of(owner))
    try:
        yield
    finally:
        _take(before, groups)


def _take(owner: Owner, groups: list[int]) -> None:
    os.seteuid(0)
    os.setgroups(groups)
    os.setegid(owner.gid)
    os.seteuid(owner.uid)


def _rights_of(owner: Owner) -> tuple[Owner, list[int]]:
    """Return the user with a group (``owner``'s if the user is in it, else the primary), and all the user's groups."""
    import pwd  # which Windows lacks

    with suppress(KeyError):  # the user has no entry
        user = pwd.getpwuid(owner.uid)
        groups = os.getgrouplist(user.pw_name, user.pw_gid)
        return Owner(owner.uid, owner.gid if owner.gid in groups else user.pw_gid), groups
    return Owner(owner.uid, owner.uid), [owner.uid]  # without an entry: the user's number stands for the only group
