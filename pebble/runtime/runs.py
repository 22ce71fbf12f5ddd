"""Numbers the runs of scripts, so that a motor owner can tell an old run from a new one."""

from __future__ import annotations

import fcntl
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

from pebble.config import Config
from pebble.contract.payloads import LAST_RUN
from pebble.errors import PebbleError

log = logging.getLogger(__name__)

RUN = "PEBBLE_RUN"  # the number of its run, in the environment of a script that signs its drive commands itself

SUPERSEDED = "superseded: a newer run drives the robot"  # why a run has ended
CONFIG = "PEBBLE_CONFIG"  # the path of the robot's config, in every script's environment

_DIGITS = 10  # of the number in the file
_LOCKED_S = 2.0
_TRY_S = 0.005
_EPOCH_S = 1_735_689_600  # 2025-01-01: counted from here, seconds fit into a run's number until 2059


def next_run(config: Config, above: int = 0) -> int:
    """The number of a run that starts now: above every earlier one of this robot, and ``above`` the given one.

    Several processes may call this at once. Without the file, or with a damaged one, it counts from the clock. Raises
    PebbleError if there are no numbers left, or if another process does not give the file free.
    """
    return _next(config.state_file("autonomy-run"), above, time.time)


def _next(path: Path, above: int, wall_clock: Callable[[], float]) -> int:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o600)
    except OSError as error:
        log.warning("%s cannot be opened (%s): the run's number is made from the clock", path, error.strerror)
        return _above(max(above, _from_clock(wall_clock)))
    try:
        _lock(file, path)
        number = _above(max(above, _read(file, path, wall_clock)))
        os.pwrite(file, f"{number:0{_DIGITS}d}\n".encode(), 0)
        os.fsync(file)
    except OSError as error:
        log.warning("%s cannot be written (%s): the run's number is made from the clock", path, error.strerror)
        number = _above(max(above, _from_clock(wall_clock)))
    finally:
        os.close(file)
    return number


def _lock(file: int, path: Path) -> None:
    """Wait for other processes, but not for one that is frozen meanwhile. Raises PebbleError."""
    deadline = time.monotonic() + _LOCKED_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise PebbleError(f"no run can begin: end what has locked {path}") from None
        time.sleep(_TRY_S)


def _read(file: int, path: Path, wall_clock: Callable[[], float]) -> int:
    raw = os.pread(file, 64, 0).strip()
    if len(raw) == _DIGITS and raw.isdigit() and int(raw) < LAST_RUN:
        return int(raw)
    if raw:
        log.warning("%s is damaged, or its numbers have ended: the run's number is made from the clock", path)
    return _from_clock(wall_clock)


def _from_clock(wall_clock: Callable[[], float]) -> int:
    """Seconds since 2025; 0 by a clock that was never set or is far ahead."""
    seconds = int(wall_clock()) - _EPOCH_S
    return seconds if 0 < seconds < LAST_RUN // 2 else 0


def _above(number: int) -> int:
    if number >= LAST_RUN:
        raise PebbleError(f"run numbers end at {LAST_RUN}: restart the robot's computer")
    return number + 1
