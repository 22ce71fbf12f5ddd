"""The poses of a running world's robots, in a file in memory: one program writes it, the robots' cameras read it.

Each write replaces the file, so a reader never waits, and never sees half of it.
"""

import fcntl
import hashlib
import os
import time
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track

PERIOD_S: Final = 0.02  # between samples
_SAMPLES = 64  # per robot: 1.28 s


class _Page(msgspec.Struct):
    """The content of the file. ``start_ns``: when its program began; ``robots``: each robot's samples, oldest first."""

    start_ns: int
    robots: dict[str, list[Sample]]


def page_path(world: Path) -> Path:
    """Return the path of the page of a world file, the same for all programs of one user."""
    folder = Path("/dev/shm")  # noqa: S108 - the page's own folder is checked
    digest = hashlib.sha256(str(world.resolve()).encode()).hexdigest()[:16]
    return folder / f"pebble-worlds-{os.getuid()}" / digest


class PosePage:
    """The writer of the page. Raises DeviceError if another program runs this world, or the page cannot be made."""

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        """Lock the world for this program, and write an empty page."""
        self._path, self._new, self._start_ns = path, path.with_suffix(".new"), time.monotonic_ns()
        self._samples: dict[str, deque[Sample]] = {name: deque(maxlen=_SAMPLES) for name in names}
        try:
            path.parent.mkdir(mode=0o700, exist_ok=True)
            status = path.parent.lstat()
            if status.st_uid != os.getuid() or status.st_mode & 0o022 or not path.parent.is_dir():
                raise DeviceError(f"{path.parent}: is not a folder that only you may write, remove it")
            self._lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o600)  # the file is never removed
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._replace()
        except BlockingIOError:
            os.close(self._lock)
            raise DeviceError("this world runs already, end its other program first") from None
        except OSError as error:
            raise DeviceError(f"{path}: the world's poses cannot be written: {error.strerror}") from None

    def write(self, ns: int, poses: Sequence[RobotPose]) -> None:
        """Add the robots' poses at ``ns``, in the order of ``names``."""
        for samples, pose in zip(self._samples.values(), poses, strict=True):
            samples.append(Sample(ns, pose))
        self._replace()

    def close(self) -> None:
        """Remove the page, by which readers notice at once that the world has ended."""
        self._path.unlink(missing_ok=True)
        os.close(self._lock)

    def _replace(self) -> None:
        robots = {name: list(samples) for name, samples in self._samples.items()}
        self._new.write_bytes(msgspec.msgpack.encode(_Page(self._start_ns, robots)))
        self._new.replace(self._path)


class PoseReader:
    """A reader of the page at ``path``. Raises OSError or msgspec.DecodeError if there is none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._start_ns = self._read().start_ns

    def tracks(self) -> dict[str, Track]:
        """Return the poses of every robot that has a sample; none once the world has ended or has restarted."""
        try:
            page = self._read()
        except FileNotFoundError:
            return {}
        if page.start_ns != self._start_ns:
            return {}
        return {name: Track(samples) for name, samples in page.robots.items() if samples}

    def _read(self) -> _Page:
        return msgspec.msgpack.decode(self._path.read_bytes(), type=_Page)
