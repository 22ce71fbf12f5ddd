"""One launcher of a robot and its config file on the machine, in any environment: by the name of an abstract socket."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from pebble.config import LAUNCHER_LOCK, RUN_DIR_OF_UNIT
from pebble.errors import PebbleError
from pebble.transports.socket_holders import command_of, processes_with

log = logging.getLogger(__name__)

#: A launcher takes connections more often than that, once it runs: before, or if it hangs, its queue has some room.
_ANSWER_S = 3.0
_PEER = struct.Struct("3i")  # SO_PEERCRED: process, user, group
_SO_PEERGROUPS = 59
_LISTED_FIELDS = 8  # of /proc/net/unix; the last is the name
_UNMAPPED = 65534  # how a user namespace shows users that it does not have
_STREAM = "0001"
_QUEUE = 128  # connections that wait to be taken


class MachineName:
    """The bound name. Any user may bind any name, so that one proves nothing, and a foreign one keeps no robot down.

    A launcher that finds the name bound, but not by a launcher, takes one below it that cannot be foreseen; then it
    looks at all of them, so that of two launchers at least one sees the other. A launcher is a process whose user may
    run this robot, and which has a launcher's lock file open; if we may not look into it, its user decides.
    """

    def __init__(self, bound: socket.socket) -> None:
        self._bound = bound
        self.name = bound.getsockname()[1:].decode()

    @classmethod
    def take(cls, robot: str, config: Path) -> MachineName:
        """Raises PebbleError if another launcher runs this robot from ``config``."""
        digest = hashlib.sha256(os.fsencode(config.resolve()) + b"\0" + robot.encode()).hexdigest()
        name, own = f"pebble up {digest[:32]}", f"pebble up {digest[:32]} {os.urandom(8).hex()}"
        looked_at, end = {own}, time.monotonic() + _ANSWER_S
        strangers: list[_Holder] = []
        try:
            if (bound := _bind(name)) is not None:
                looked_at = {name}
            else:
                strangers += _strangers(robot, config, _holders(name, looked_at, end))
                bound = _bind(own)
        except OSError as error:
            raise PebbleError(f"{robot} cannot be locked: {error.strerror}") from None
        if bound is None:
            raise PebbleError(f"{robot} cannot be locked: all names are taken")
        try:
            strangers += _strangers(robot, config, _holders(name, looked_at, end))
        except PebbleError:
            bound.close()
            raise
        if strangers:
            log.warning("%s starts although %s", robot, _described(strangers, name))
        return cls(bound)

    def answer(self) -> None:
        """Take the connections of those that have asked: a full queue would hide who holds the name."""
        with suppress(OSError):
            for _ in range(_QUEUE):
                self._bound.accept()[0].close()

    def close(self) -> None:
        self._bound.close()


class _Holder(NamedTuple):
    process: int  # 0: unknown
    user: int
    groups: tuple[int, ...]
    is_launcher: bool


_UNKNOWN = _Holder(0, -1, (), is_launcher=False)


def _strangers(robot: str, config: Path, holders: Iterator[_Holder]) -> Iterator[_Holder]:
    """All holders, if none is a launcher. Raises PebbleError if one is."""
    for holder in holders:
        if holder.is_launcher and _may_run(holder, config):
            raise PebbleError(
                f"{robot} already runs from {config}, with another run directory: process {holder.process}"
                f" of user {holder.user}; end that one first"
            )
        yield holder


def _bind(name: str) -> socket.socket | None:
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        bound.bind(f"\0{name}")
        bound.listen(_QUEUE)
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return bound


def _holders(name: str, done: set[str], end: float) -> Iterator[_Holder]:
    """Those of ``name`` and of all names below it, not ``done`` yet; at ``end`` also those that do not answer."""
    last = False
    while not last and (names := {held: inodes for held, inodes in _listed(name).items() if held not in done}):
        last = time.monotonic() > end
        seen = _seen_holders({inode for inodes in names.values() for inode in inodes})
        for held, inodes in names.items():
            found = [holder for inode in inodes for holder in seen.get(inode, ())]
            if not found and (asked := _ask(held)):
                found = [asked]
            if found or last:
                done.add(held)
                yield max(found, key=lambda holder: holder.is_launcher, default=_UNKNOWN)
        if not last and not names.keys() <= done:
            time.sleep(0.2)  # it is about to listen, its queue is full, or it has ended


def _listed(name: str) -> dict[str, set[str]]:
    """The inodes of the sockets that are bound to each name."""
    names: dict[str, set[str]] = {}
    with suppress(OSError):
        for line in Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace").splitlines():
            fields = line.split(maxsplit=_LISTED_FIELDS - 1)
            if len(fields) == _LISTED_FIELDS and fields[4] == _STREAM and f"{fields[7]} ".startswith(f"@{name} "):
                names.setdefault(fields[7][1:], set()).add(fields[6])
    return names


def _seen_holders(inodes: set[str]) -> dict[str, list[_Holder]]:
    seen: dict[str, list[_Holder]] = {}
    for process, links, held in processes_with(inodes):
        with suppress(OSError):  # it has ended
            holder = _process(process, links)
            for inode in held:
                seen.setdefault(inode, []).append(holder)
    return seen


def _process(process: Path, links: dict[Path, str]) -> _Holder:
    """Its lock file belongs to its user: a descriptor may be inherited by a program that changes its user."""
    status = {}
    for line in (process / "status").read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, words = line.partition(":")
        if key in ("Uid", "Gid", "Groups"):
            status[key] = [int(word) for word in words.split()]
    user = status["Uid"][0]
    is_launcher = any(
        Path(link.removesuffix(" (deleted)")).name == LAUNCHER_LOCK and entry.stat().st_uid == user
        for entry, link in links.items()
    )
    return _Holder(int(process.name), user, (status["Gid"][0], *status["Groups"]), is_launcher)


def _ask(name: str) -> _Holder | None:
    """The process that listens at a name that none has which we may look into; None if it does not take us."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as asking:
        try:
            asking.connect(f"\0{name}")
        except OSError:
            return None
        process, user, group = _PEER.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        groups: tuple[int, ...] = (group,)
        with suppress(OSError):  # more than Python reads
            groups += tuple(memoryview(asking.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 1024)).cast("I"))
    return _Holder(process, user, groups, is_launcher=True)


def _may_run(holder: _Holder, config: Path) -> bool:
    """Whether files say so: the config is its user's or a group's with more rights than all have, or root set up /run.

    Another user who may read the config cannot be told from one who wants to keep the robot down.
    """
    if holder.user == _UNMAPPED and not _sees_all_users():
        return False
    users = {0, os.getuid()}
    with suppress(OSError):
        users.add(RUN_DIR_OF_UNIT.stat().st_uid)
    with suppress(OSError):
        found = config.stat()
        users.add(found.st_uid)
        if found.st_mode >> 3 & ~found.st_mode & 0o6 and found.st_gid in holder.groups:
            return True
    return holder.user in users


def _sees_all_users() -> bool:
    """False in a user namespace that shows several users as one."""
    with suppress(OSError):
        return Path("/proc/self/uid_map").read_text(encoding="ascii").split() == ["0", "0", "4294967295"]
    return False


def _described(strangers: list[_Holder], name: str) -> str:
    known = next((holder for holder in strangers if holder.process), None)
    more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
    if known is None:
        who, end = "a process that this user may not see", f"find it with: sudo ss -xap | grep '{name}'"
    else:
        who = f"process {known.process} of user {known.user} ({command_of(known.process)})"
        end = f"end it with: sudo kill {known.process}"
    return (
        f"{who}{more} has bound the name by which launchers of a robot find each other, and is not known as one of them"
        f" (if it is, two run now); {end}"
    )
