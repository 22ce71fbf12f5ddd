"""Who is alive in a run directory: one locked file per process, so that death needs no message and no timeout.

A process holds a lock on its ``<name>.seat`` for as long as it lives; the kernel releases it however the process
ends. Whoever finds an unlocked seat clears the dead one's files away. The owner writes who it is into its seat once it
listens, and is ready then: a newcomer waits for those who are ready, and those who become ready later wait for the
newcomer, so that of any two at least one waits for the other.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from pebble.errors import TransportError

_SOCKET_PATH_LIMIT = 108  # bytes, sizeof(sun_path): a longer path cannot be bound
_OWNER_BYTES = 200
_RESERVED = "?#;"  # these separate the parts of a Zenoh endpoint


def prepare_run_dir(run_dir: Path) -> None:
    """Make ``run_dir`` for this user alone, if it is missing. Raises TransportError if no socket can live there."""
    longest = run_dir / f"{new_name()}.sock"
    if len(os.fsencode(longest)) >= _SOCKET_PATH_LIMIT:
        raise TransportError(
            f"{longest} is too long for a unix socket (limit {_SOCKET_PATH_LIMIT - 1} bytes): "
            "set transport.run_dir to a shorter path"
        )
    if any(character in str(run_dir) for character in _RESERVED):
        raise TransportError(f"transport.run_dir {run_dir} must not contain any of {_RESERVED}")
    try:
        run_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise TransportError(f"transport.run_dir {run_dir} cannot be made: {error.strerror}") from None


class Lock:
    """An exclusive lock on a file that ends with the process."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    @classmethod
    def take(cls, path: Path) -> Lock | None:
        """Lock ``path``, made if it is missing; None if somebody else has it."""
        try:
            return cls._get(path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return None

    @classmethod
    def wait(cls, path: Path) -> Lock:
        """The same for a path of our own: whoever has it only looks whether somebody lives there."""
        return cls._get(path, fcntl.LOCK_EX)

    @classmethod
    def _get(cls, path: Path, how: int) -> Lock:
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(descriptor, how)
            except BlockingIOError:
                os.close(descriptor)
                raise
            if _is_at(path, descriptor):
                return cls(path, descriptor)
            os.close(descriptor)  # swept between its making and its locking

    def write(self, text: bytes) -> None:
        os.pwrite(self._descriptor, text, 0)

    def release(self) -> None:
        self.path.unlink(missing_ok=True)
        os.close(self._descriptor)


class Seat:
    """One living process's place in the run directory."""

    def __init__(self, run_dir: Path, name: str, owner: str, lock: Lock) -> None:
        self.name, self._owner = name, owner
        self.socket = run_dir / f"{name}.sock"
        self._lock = lock

    def ready(self) -> None:
        """From now on newcomers wait until they have met us."""
        self._lock.write(self._owner.encode() or b"?")

    def leave(self) -> None:
        _clear_socket(self.socket)
        self._lock.release()


class Roster:
    """The seats of one run directory."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir

    def enter(self, owner: str) -> Seat:
        name = new_name()
        return Seat(self._run_dir, name, owner, Lock.wait(self._run_dir / f"{name}.seat"))

    def sockets(self, *, but: str = "") -> list[Path]:
        """Where the living listen or are about to."""
        return [self._run_dir / f"{name}.sock" for name in self._living() if name != but]

    def ready(self, *, but: str = "") -> dict[str, str]:
        """The owners of the seats of all who are surely reachable, by name."""
        return {name: owner for name, owner in self._living().items() if owner and name != but}

    def _living(self) -> dict[str, str]:
        seats = {path.stem: _look(path) for path in self._run_dir.glob("*.seat")}
        return {name: owner for name, owner in seats.items() if owner is not None}


def new_name() -> str:
    """Short, because it becomes part of a socket's path, and nobody else's."""
    return os.urandom(4).hex()


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _look(seat: Path) -> str | None:
    """What the seat's owner wrote; None, and its files cleared away, if it is dead."""
    try:
        descriptor = os.open(seat, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return os.pread(descriptor, _OWNER_BYTES, 0).decode(errors="replace")
    else:
        if _is_at(seat, descriptor):  # else it has been swept and may be somebody's new seat
            _clear_socket(seat.with_suffix(".sock"))
            seat.unlink(missing_ok=True)
        return None
    finally:
        os.close(descriptor)


def _clear_socket(socket: Path) -> None:
    socket.unlink(missing_ok=True)
    socket.with_name(socket.name + ".lock").unlink(missing_ok=True)  # Zenoh's own
