"""Run numbers of scripts, by which a motor owner tells an old run from a new one.

:func:`pebble.motion.arbiter.newer` decides which of two is newer: the numbers have no end.
"""

import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pebble.config import Config
from pebble.contract.payloads import LAST_RUN
from pebble.errors import PebbleError
from pebble.motion.arbiter import newer
from pebble.runtime.whole_file import sync_file

log = logging.getLogger(__name__)

RUN = "PEBBLE_RUN"  # the number of its run, in the environment of a script that signs its drive commands itself

SUPERSEDED = "superseded: a newer run drives the robot"  # why a run has ended
CONFIG = "PEBBLE_CONFIG"  # the path of the robot's config, in every script's environment

_DIGITS = 10  # of the number in the file
_LOCKED_S = 2.0
_TRY_S = 0.005
_EPOCH_S = 1_735_689_600  # 2025-01-01: counted from here, seconds fit into a run's number until 2059


class LocalScriptsLock:
    """A lock on a file: each script of this robot, or its manager, holds it from before the script gets a run number.

    A neighbour, which is another robot, takes the number for driving this robot while nothing holds the lock. So a
    script of this robot that starts later has a newer number, and goes before the neighbour. The kernel releases the
    lock of a killed process.
    """

    def __init__(self, config: Config) -> None:
        self._path = config.run_dir() / "local-scripts.lock"
        self._held: int | None = None

    def hold(self) -> None:
        """Lock the file while a script runs. The script runs even if this fails.

        Where the system refuses the lock, it refuses it to :meth:`none_runs`, too. That then yields False, so no script
        of a neighbour drives this robot: it would need a run number from here, which it gets only while none runs.
        """
        if self._held is None:
            try:
                self._held = self._open()
                _lock(self._held, self._path, fcntl.LOCK_SH)
            except (OSError, PebbleError) as error:
                log.debug("the lock of local scripts is not held: %s", error)

    def release(self) -> None:
        file, self._held = self._held, None
        if file is not None:
            os.close(file)

    @contextmanager
    def none_runs(self) -> Iterator[bool]:
        """Yield True if no script runs, and prevent one during the block; False if one runs, or that is unknown.

        If it yields False, no script of a neighbour may drive this robot.
        """
        try:
            file = self._open()
        except OSError as error:
            log.warning("%s cannot be opened (%s): no neighbour drives", self._path, error.strerror)
            yield False
            return
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(file)
            if not isinstance(error, BlockingIOError):
                log.warning("%s cannot be locked (%s): no neighbour drives", self._path, error.strerror)
            yield False
            return
        try:
            yield True
        finally:
            os.close(file)

    def _open(self) -> int:
        return os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)


def newest(runs: Iterable[int]) -> int:
    """Return the newest of ``runs``, where 0 stands for none."""
    newest_run = 0
    for run in runs:
        if newer(run, newest_run):
            newest_run = run
    return newest_run


def following(run: int) -> int:
    return run + 1 if run < LAST_RUN else 1


def next_run(config: Config, barred: int = 0, received: int = 0) -> int:
    """Return the number of a run that starts now: newer than ``barred``, which motor owners report.

    It is also newer than the last run of this robot, which a file holds, and than ``received``, the newest run whose
    commands have come. Either is left out if it is far ahead of ``barred``, as a number from a stranger may be: the
    numbers go round, so it counts as older.

    Several processes may call this at once. If the file is missing or damaged, the number is made from the clock.
    Raises PebbleError if another process does not release the file.
    """
    return _next(config.state_file("autonomy-run"), barred, time.time, received)


def _next(path: Path, barred: int, wall_clock: Callable[[], float], received: int = 0) -> int:
    """Store and return the next number, as :func:`next_run` says; ``path`` holds the last one."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o600)
    except OSError as error:
        log.warning("%s cannot be opened (%s): the run's number is made from the clock", path, error.strerror)
        return _above(barred, received, _from_clock(wall_clock))
    try:
        _lock(file, path)
        number = _above(barred, received, _read(file, path, wall_clock))
        os.pwrite(file, f"{number:0{_DIGITS}d}\n".encode(), 0)
        sync_file(file)
    except OSError as error:
        log.warning("%s cannot be written (%s): the run's number is made from the clock", path, error.strerror)
        number = _above(barred, received, _from_clock(wall_clock))
    finally:
        os.close(file)
    return number


def _lock(file: int, path: Path, how: int = fcntl.LOCK_EX) -> None:
    """Lock a file, waiting for other processes, but not for a frozen one. Raises PebbleError, or OSError."""
    if not locked_within(_LOCKED_S, file, how):
        raise PebbleError(f"no run can begin: end what has locked {path}")


def locked_within(seconds: float, file: int, how: int = fcntl.LOCK_EX) -> bool:
    """Lock a file; return False if others hold it for so long. Raises OSError where the system has no locks."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() > deadline:
                return False
        time.sleep(_TRY_S)


def _read(file: int, path: Path, wall_clock: Callable[[], float]) -> int:
    raw = os.pread(file, 64, 0).strip()
    if len(raw) == _DIGITS and raw.isdigit() and int(raw) <= LAST_RUN:
        return int(raw)
    if raw:
        log.warning("%s is damaged: the run's number is made from the clock", path)
    return _from_clock(wall_clock)


def _from_clock(wall_clock: Callable[[], float]) -> int:
    """Return the seconds since 2025; 0 if the clock was never set, or shows a far future."""
    seconds = int(wall_clock()) - _EPOCH_S
    return seconds if 0 < seconds < LAST_RUN // 2 else 0


def _above(barred: int, *used: int) -> int:
    """Return the number after the newest of ``barred`` and ``used``; 0 stands for no number.

    The numbers form a circle: after the last one comes 1. From ``barred`` on, half of the circle counts as newer, the
    other half as older. A used number counts only if the number after it is in the newer half.
    """
    base = barred or newest(used)
    steps_ahead = [(run - base) & LAST_RUN for run in used if run and newer(following(run), base)]
    return following((base + max(steps_ahead, default=0)) & LAST_RUN)
