"""Finds the processes that hold a socket, among those that this user may see: root sees all."""

import errno
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

_SHOWN = 60  # characters of a command
_LISTENS = "0A"  # in /proc/net/tcp
_PREFIX = "socket:["  # of the target of a link in /proc/PID/fd, before the inode and a bracket


def _processes_with(inodes: Collection[str]) -> Iterator[tuple[Path, set[str]]]:
    """Yield each process that holds some of these sockets: its folder in /proc, and their inodes."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            links = []
            for entry in (process / "fd").iterdir():
                with suppress(OSError):  # closed meanwhile
                    links.append(str(entry.readlink()))
            sockets = {link.removeprefix(_PREFIX).rstrip("]") for link in links if link.startswith(_PREFIX)}
            held = sockets.intersection(inodes)
            if held:
                yield process, held


def _command_of(process: int) -> str:
    """Return the command line of a process in a form that is safe to print."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        return f"its command cannot be seen: {error.strerror}"
    return ascii(words.replace("\0", " ").strip()[:_SHOWN])


def why_not(error: OSError, port: int) -> str:
    """Return why this TCP port could not be opened; if it is in use, with the process, if that is found."""
    return f"{error.strerror}{port_holder(port)}" if error.errno == errno.EADDRINUSE else str(error.strerror)


def port_holder(port: int) -> str:
    """Return who listens at a port, as `` (by process 12 of user 1000: 'nc -l 8080')`` with its blank; else ""."""
    users = {}  # of listening sockets at the port, by their inodes
    for name in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in Path("/proc/net", name).read_text(encoding="ascii").splitlines()[1:]:
                fields = line.split()  # [1] the own address, [3] the state, [7] the user, [9] the inode
                if fields[3] == _LISTENS and fields[1].endswith(f":{port:04X}"):
                    users[fields[9]] = fields[7]
    for process, held in _processes_with(users):  # only the first one is shown
        return f" (by process {process.name} of user {users[held.pop()]}: {_command_of(int(process.name))})"
    if users:
        return f" (by a process of user {users.popitem()[1]}: sudo ss -ltnp 'sport = :{port}')"
    return ""
