"""The poses of a running world's robots in shared memory: one program writes them, every robot's camera reads them.

Each robot has a ring of samples. A sample has a checksum: whatever a reader catches half written is left out, and it is
the oldest of the ring. So readers never wait, and nothing depends on the order in which a CPU makes writes visible.
"""

import fcntl
import hashlib
import mmap
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track
from pebble.extensions.lab.simulation.world.world_file import LONGEST_NAME, MOST_ROBOTS

PERIOD_S: Final = 0.02  # between samples
_SAMPLES = 64  # per robot: 1.28 s
_WORDS = 5  # of a sample: ns, x, y, heading, checksum
_HEADER = 2  # words: magic, start
_ABANDONED_S = 60.0
_MAGIC = int.from_bytes(b"PebPose1", "little")
_SLOT = LONGEST_NAME // 8 + _SAMPLES * _WORDS  # words
_SIZE = 8 * (_HEADER + MOST_ROBOTS * _SLOT)
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93], np.uint64)
_CHECK = np.uint64(0x5045424C)  # so that zeros are no sample

_Words: TypeAlias = NDArray[np.uint64]


def page_path(world: Path) -> Path:
    """The page of a world file, the same for all programs of one user."""
    folder = Path("/dev/shm")  # noqa: S108 - the page's own folder is checked
    digest = hashlib.sha256(str(world.resolve()).encode()).hexdigest()[:16]
    return folder / f"pebble-worlds-{os.getuid()}" / digest


class PosePage:
    """The writer. Raises DeviceError if another program runs this world, or the page cannot be made."""

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        self._path, self._turn = path, 0
        try:
            path.parent.mkdir(mode=0o700, exist_ok=True)
            _refuse_foreign(path.parent)
            _remove_abandoned(path.parent)
            self._file = _lock(path)
            os.ftruncate(self._file, _SIZE)
        except OSError as error:
            raise DeviceError(f"{path}: the world's poses cannot be written: {error.strerror}") from None
        self._words = words = _map(self._file, writable=True)
        words[:] = 0
        slots = words[_HEADER:].reshape(MOST_ROBOTS, _SLOT)
        self._rings = []
        for slot, name in zip(slots, names, strict=False):
            slot[: LONGEST_NAME // 8] = np.frombuffer(name.encode().ljust(LONGEST_NAME, b"\0"), np.uint64)
            self._rings.append(slot[LONGEST_NAME // 8 :].reshape(_SAMPLES, _WORDS))
        words[1] = time.monotonic_ns()
        words[0] = _MAGIC

    def write(self, ns: int, poses: Sequence[RobotPose]) -> None:
        """Add where the robots are at ``ns``, in the order of ``names``."""
        values = np.array([(0.0, *pose, 0.0) for pose in poses]).view(np.uint64)
        values[:, 0] = ns
        values[:, 4] = _checksums(values)
        for ring, sample in zip(self._rings, values, strict=True):
            ring[self._turn % _SAMPLES] = sample
        self._turn += 1

    def close(self) -> None:
        """Remove the page: a world that does not run has none, and readers notice at once."""
        self._words[0] = 0
        self._path.unlink(missing_ok=True)
        os.close(self._file)
        self._rings.clear()


class PoseReader:
    """A reader of the page at ``path``. Raises FileNotFoundError or ValueError if there is none that can be used."""

    def __init__(self, path: Path) -> None:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        try:
            found = os.fstat(file)
            if found.st_size != _SIZE or found.st_uid != os.getuid():
                raise ValueError(f"{path} is not complete, or another user's")
            self._words = _map(file, writable=False)
        finally:
            os.close(file)
        self._start = int(self._words[1])
        if not self.is_valid:
            raise ValueError(f"{path} is not complete")

    @property
    def is_valid(self) -> bool:
        """False when the world has ended or was started again."""
        return int(self._words[0]) == _MAGIC and int(self._words[1]) == self._start

    def tracks(self) -> dict[str, Track]:
        """The poses of every robot that has a sample."""
        tracks = {}
        for slot in self._words[_HEADER:].reshape(MOST_ROBOTS, _SLOT):
            name = slot[: LONGEST_NAME // 8].tobytes().rstrip(b"\0").decode()
            if not name:
                break
            if samples := _samples(slot[LONGEST_NAME // 8 :].reshape(_SAMPLES, _WORDS).copy()):
                tracks[name] = Track(samples)
        return tracks


def _samples(ring: _Words) -> list[Sample]:
    """The samples that are whole, oldest first."""
    whole = ring[ring[:, 4] == _checksums(ring)]
    whole = whole[np.argsort(whole[:, 0])]
    times: list[int] = whole[:, 0].tolist()
    poses: list[list[float]] = whole[:, 1:4].view(np.float64).tolist()
    return [Sample(ns, RobotPose(*pose)) for ns, pose in zip(times, poses, strict=True)]


def _checksums(samples: _Words) -> _Words:
    """The hash of each row; overflow is intended."""
    return np.asarray((samples[:, :4] * _FACTORS).sum(axis=1, dtype=np.uint64) + _CHECK)


def _map(file: int, *, writable: bool) -> _Words:
    access: Any = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
    return np.frombuffer(mmap.mmap(file, _SIZE, access=access), np.uint64)


def _refuse_foreign(folder: Path) -> None:
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022 or not folder.is_dir():
        raise DeviceError(f"{folder}: is not a folder that only you may write, remove it")


def _remove_abandoned(folder: Path) -> None:
    """Remove the pages of programs that were killed; not the newest, whose programs may be about to lock them."""
    for path in folder.iterdir():
        with suppress(OSError), path.open("rb") as file:
            if time.time() - os.fstat(file.fileno()).st_ctime > _ABANDONED_S:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()


def _lock(path: Path) -> int:
    """Open the page, locked. A page that its writer removed in the meantime is made anew."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and path.stat().st_ino == os.fstat(file).st_ino:
                return file
        except BlockingIOError:
            os.close(file)
            raise DeviceError("this world runs already, end its other program first") from None
        os.close(file)
