"""The processes of a run directory: each locks a file, so that its exit needs neither a message nor a timeout.

A process holds a lock on its ``<name>.seat`` as long as it runs; the kernel releases it however the process ends. A
process that finds an unlocked file removes the files of its former owner. The owner writes its name into the file when
it listens, and is ready from then on: a newcomer waits for all that are ready, and those that become ready later wait
for the newcomer, so that of any two at least one waits for the other.
"""

from __future__ import annotations

import fcntl
import logging
import os
import stat
import threading
from contextlib import suppress
from pathlib import Path

from pebble.errors import TransportError
from pebble.transports.own_file import identity
from pebble.transports.socket_paths import check_socket_path

log = logging.getLogger(__name__)

_OWNER_BYTES = 200
_RESERVED = "?#;"  # these separate the parts of a Zenoh endpoint


def prepare_run_dir(run_dir: Path) -> None:
    """Create the folder for sockets, private to this user.

    Raises TransportError, also if its path is too long for a socket or has a reserved character.
    """
    check_socket_path(run_dir / f"{new_name()}.sock")
    if any(character in str(run_dir) for character in _RESERVED):
        raise TransportError(f"transport.run_dir {run_dir} must not contain any of {_RESERVED}")
    make_private(run_dir)


def make_private(run_dir: Path, *, close: bool = False) -> None:
    """Create ``run_dir`` for this user alone, if it is missing; ``close`` takes access from others if it exists.

    Raises TransportError for a folder in which others may write: they could control the robot, and feed its programs.
    In /tmp another user may have created these names first.
    """
    try:
        run_dir.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        for owner in (run_dir.parent.lstat().st_uid, run_dir.parent.stat().st_uid):  # of a link, and of what it names
            if owner not in (os.getuid(), 0):
                raise TransportError(
                    f"transport.run_dir {run_dir}: the folder it is in belongs to another user ({owner}):"
                    " remove it as that user or root, or set transport.run_dir to another folder"
                )
        run_dir.mkdir(mode=0o700, exist_ok=True)
        folder = run_dir.lstat()
        if not stat.S_ISDIR(folder.st_mode) or folder.st_uid != os.getuid():
            raise TransportError(
                f"transport.run_dir {run_dir} is not a folder of this user: "
                "run this as the user of the robot, or remove what is there"
            )
        is_shared = folder.st_mode & stat.S_ISVTX  # the sticky bit: a folder for all users, such as /tmp, stays so
        if close and folder.st_mode & 0o077 and not is_shared:
            run_dir.chmod(0o700)
        elif folder.st_mode & 0o022:
            raise TransportError(f"transport.run_dir {run_dir}: others may write there, name a folder of this user")
    except OSError as error:
        raise TransportError(
            f"transport.run_dir {run_dir} cannot be used: {error.strerror}; name another folder"
        ) from None


class FileLock:
    """An exclusive lock on a file. The kernel releases it when the process ends.

    Taking a lock raises TransportError if the file cannot be created.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    @classmethod
    def take(cls, path: Path) -> FileLock | None:
        """Return the lock of ``path``, which is created if missing; None if another process has locked it."""
        try:
            return cls._get(path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return None

    @classmethod
    def wait(cls, path: Path) -> FileLock:
        """Lock a file for this process; wait if another, which looks whether the owner runs, holds it for a moment."""
        return cls._get(path, fcntl.LOCK_EX)

    @classmethod
    def _get(cls, path: Path, how: int) -> FileLock:
        while True:
            descriptor = _open_lock(path)
            try:
                fcntl.flock(descriptor, how)
            except OSError as error:
                os.close(descriptor)
                if isinstance(error, BlockingIOError):
                    raise
                raise _no_lock(path, error) from None
            if _is_at(path, descriptor):
                return cls(path, descriptor)
            os.close(descriptor)  # removed between open and flock

    @property
    def in_place(self) -> bool:
        """True if others that open its path find this lock: the file and its folder are still there."""
        return _is_at(self.path, self._descriptor)

    def write(self, text: bytes) -> None:
        """Replace the text in the file. If the disk is full, zeros remain, which count as a text that says nothing."""
        try:
            os.truncate(self._descriptor, len(text))  # needs no space
            os.pwrite(self._descriptor, text, 0)
        except OSError as error:
            log.warning("%s cannot be written: %s", self.path, error.strerror)

    def release(self, *, remove: bool = True) -> None:
        """Release the lock; ``remove`` also deletes the file, unless another file has taken its place."""
        if remove and self.in_place:
            self.path.unlink(missing_ok=True)
        os.close(self._descriptor)


class PresenceLock:
    """The lock by which a process shows that it runs, and the path of its socket."""

    def __init__(self, run_dir: Path, name: str, owner: str, lock: FileLock) -> None:
        self.name, self._owner = name, owner
        self.socket = run_dir / f"{name}.sock"
        self._lock = lock
        self._changing = threading.Lock()  # guards what follows, and the descriptor of the lock
        self._released = False

    def ready(self) -> None:
        """Mark this process as reachable; from now on newcomers wait for its answer."""
        with self._changing:
            if not self._released:
                self._lock.write(self._owner.encode() or b"?")

    def release(self) -> None:
        _clear_socket(self.socket)
        with self._changing:
            if not self._released:
                self._released = True
                self._lock.release()


class PeerRegistry:
    """The presence locks of one run directory."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir

    def register(self, owner: str) -> PresenceLock:
        """Add this process under a new name; return its lock. ``owner`` describes it in logs."""
        name = new_name()
        return PresenceLock(self._run_dir, name, owner, FileLock.wait(self._run_dir / f"{name}.seat"))

    def sockets(self, *, but: str = "") -> list[Path]:
        """Return the sockets of running processes, even if they do not listen yet, except the one called ``but``."""
        return [self._run_dir / f"{name}.sock" for name in self._running() if name != but]

    def ready(self, *, but: str = "") -> dict[str, str]:
        """Return the ``owner`` of each reachable process (see `register`), by its name; not of the process ``but``."""
        return {name: owner for name, owner in self._running().items() if owner and name != but}

    def _running(self) -> dict[str, str]:
        owners = {}  # by the name of a process that runs: its ``owner``, "" until it is ready
        with suppress(FileNotFoundError):  # nothing was ever opened there
            for name in os.listdir(self._run_dir):  # noqa: PTH208  (a glob takes 300 KB for its patterns)
                path = self._run_dir / name
                if path.suffix == ".seat" and (owner := _owner_if_running(path)) is not None:
                    owners[path.stem] = owner
        return owners


def new_name() -> str:
    """Return a unique name; short, because it becomes part of a socket's path."""
    return os.urandom(4).hex()


def _is_at(path: Path, descriptor: int) -> bool:
    return identity(path) == identity(descriptor)


def _open_lock(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        remedy = "remove it, or " if os.path.lexists(path) else "make room there, or "
        raise _no_lock(path, error, remedy) from None


def _no_lock(path: Path, error: OSError, remedy: str = "") -> TransportError:
    text = f"{path} cannot be locked: {error.strerror}; {remedy}set transport.run_dir to another folder"
    return TransportError(text)


def _owner_if_running(path: Path) -> str | None:
    """Return the text of a lock file, "" until its owner is ready; if the owner has ended, remove its files: None."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:  # removed meanwhile, or no lock file
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:  # it runs; or locks do not work here, so it may run, and nothing of it may be removed
        text = os.pread(descriptor, _OWNER_BYTES, 0)
        return (text.strip(b"\0") or b"?").decode(errors="replace") if text else ""  # ?: a full disk left zeros
    else:
        if _is_at(path, descriptor):  # else it was removed, and a new process may have the name
            _clear_socket(path.with_suffix(".sock"))
            with suppress(OSError):  # a folder
                path.unlink()
        return None
    finally:
        os.close(descriptor)


def _clear_socket(socket: Path) -> None:
    socket.unlink(missing_ok=True)
    socket.with_name(socket.name + ".lock").unlink(missing_ok=True)  # Zenoh's own
