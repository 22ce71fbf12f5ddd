"""Checks of this machine. They change nothing on it."""

import os
import subprocess
import time
from resource import RLIM_INFINITY, RLIMIT_MEMLOCK, getrlimit
from typing import Any

from pebble.check_result import CheckResult, failed, ok, warn
from pebble.errors import PebbleError
from pebble.extensions.checks.check import Check
from pebble.extensions.checks.program import run

_ENOUGH_LOCKED = 64 * 1024 * 1024  # a camera's pool of frames at 1080p
_BUILT = 1735689600  # 2025: a clock before this has not been set


def memory_lock(limit: int, *, root: bool) -> CheckResult:
    """Check the lockable memory ``limit`` (bytes, or RLIM_INFINITY): with too little, readers get no frames."""
    if limit == RLIM_INFINITY or limit >= _ENOUGH_LOCKED or root:
        return ok("no limit that matters")
    return warn(
        f"limited to {limit // 1024} kB: too little for shared camera frames",
        "LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited` in a root shell",
    )


def clock(now: float, synchronised: bool | None) -> CheckResult:
    """Check the clock. ``now``: epoch seconds; ``synchronised``: None if it is unknown."""
    fix = "sudo timedatectl set-ntp true"
    if now < _BUILT:
        return failed(f"is set to {time.gmtime(now).tm_year}: stamps will be wrong", fix)
    if synchronised is False:
        return warn("is not synchronised: latencies will be wrong", fix)
    return ok("synchronised" if synchronised else "plausible; not known to be synchronised")


def synchronised() -> bool | None:
    """True if the clock is synchronised by NTP, according to systemd; None without systemd."""
    answer = printed("timedatectl", "show", "--property=NTPSynchronized", "--value")
    return {"yes": True, "no": False}.get(answer.strip())


def output_of(program: str, *arguments: str, seconds: float = 5.0, **user: Any) -> str:
    """Return a system program's standard output, run as ``user``. Raises PebbleError if it fails without output."""
    command: tuple[str, ...] = (program, *arguments)
    try:
        done = run(command, seconds, cwd="/", **user)
    except FileNotFoundError:
        raise PebbleError(f"{program} is not installed") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PebbleError(str(error)) from None
    if done.code and not done.output:
        raise PebbleError(f"{program} ended with {done.code}: {done.errors[-300:]}")
    return done.output


def printed(*command: str) -> str:
    """Return a system program's standard output; empty if it is not installed or does not end in time."""
    try:
        return output_of(*command)
    except PebbleError:
        return ""


MACHINE: tuple[Check[None], ...] = (
    Check("memory lock", lambda _: memory_lock(getrlimit(RLIMIT_MEMLOCK)[0], root=os.geteuid() == 0)),
    Check("clock", lambda _: clock(time.time(), synchronised())),
)
