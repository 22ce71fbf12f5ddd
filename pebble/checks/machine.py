"""Checks of this machine, which change nothing on it."""

import os
import resource
import shutil
import subprocess
import time

from pebble.checks.check import Check, CheckResult, failed, ok, warn

_ENOUGH_LOCKED = 64 * 1024 * 1024  # a camera's pool of frames at 1080p
_BUILT = 1735689600  # 2025: a clock before this has not been set
_TIMEDATECTL_S = 3.0


def memory_lock(limit: int, *, root: bool) -> CheckResult:
    """``limit`` in bytes, or RLIM_INFINITY. A reader that cannot lock a shared segment loses every frame silently."""
    if limit == resource.RLIM_INFINITY or limit >= _ENOUGH_LOCKED or root:
        return ok("no limit that matters")
    return warn(
        f"limited to {limit // 1024} kB: too little for shared camera frames",
        "LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited` in a root shell",
    )


def clock(now: float, synchronised: bool | None) -> CheckResult:
    """``now`` in epoch seconds; ``synchronised`` None if unknown."""
    fix = "sudo timedatectl set-ntp true"
    if now < _BUILT:
        return failed(f"is set to {time.gmtime(now).tm_year}: stamps will be wrong", fix)
    if synchronised is False:
        return warn("is not synchronised: latencies will be wrong", fix)
    return ok("synchronised" if synchronised else "plausible; not known to be synchronised")


def synchronised() -> bool | None:
    """True if the clock is synchronised by NTP, according to systemd; None without systemd."""
    if shutil.which("timedatectl") is None:
        return None
    command = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEDATECTL_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return {"yes": True, "no": False}.get(done.stdout.strip())


def _memory_lock(_: None) -> CheckResult:
    return memory_lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], root=os.geteuid() == 0)


MACHINE: tuple[Check[None], ...] = (
    Check("memory lock", _memory_lock),
    Check("clock", lambda _: clock(time.time(), synchronised())),
)
