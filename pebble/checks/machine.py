"""Checks of this machine, which change nothing on it."""

import os
import resource
import shutil
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

from pebble.checks.check import Check, CheckResult, failed, ok, warn

_ENOUGH_LOCKED = 64 * 1024 * 1024  # a camera's pool of frames at 1080p
_BUILT = 1735689600  # 2025: a clock before this has not been set
_TIMEDATECTL_S = 3.0
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where Zenoh puts its segments


def installed(package: str) -> CheckResult:
    try:
        return ok(metadata.version(package))
    except metadata.PackageNotFoundError:
        return failed("is not installed", f"{sys.executable} -m pip install {package}")


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


def leftover_segments(shm: Path, proc: Path) -> CheckResult:
    """Find Zenoh's shared memory of this user that no process has mapped."""
    segments = {path for path in shm.glob("*.zenoh") if _owner(path) == os.geteuid()}
    if not segments:
        return ok("no segments left over")
    unused = sorted(segments - _mapped(proc, segments))
    if not unused:
        return ok(f"segments in use: {len(segments)}")
    megabytes = sum(path.stat().st_size for path in unused if path.exists()) / 1e6
    return warn(
        f"left over from processes that are gone: {len(unused)} ({megabytes:.1f} MB)",
        "rm " + " ".join(map(str, unused)),
    )


def _mapped(proc: Path, paths: set[Path]) -> set[Path]:
    mapped: set[Path] = set()
    for maps in proc.glob("[0-9]*/maps"):
        try:
            text = maps.read_text(errors="replace", encoding="utf-8")
        except OSError:  # ended meanwhile, or of another user
            continue
        mapped |= {path for path in paths if str(path) in text}
    return mapped


def _owner(path: Path) -> int | None:
    try:
        return path.lstat().st_uid
    except OSError:
        return None


def _memory_lock(_: None) -> CheckResult:
    return memory_lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], root=os.geteuid() == 0)


MACHINE: tuple[Check[None], ...] = (
    Check("eclipse-zenoh", lambda _: installed("eclipse-zenoh")),
    Check("paho-mqtt", lambda _: installed("paho-mqtt")),
    Check("memory lock", _memory_lock),
    Check("clock", lambda _: clock(time.time(), synchronised())),
    Check("shared memory", lambda _: leftover_segments(_SHARED_MEMORY, Path("/proc"))),
)
