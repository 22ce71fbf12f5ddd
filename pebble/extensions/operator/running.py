"""Robots that run on this machine."""

import os
from pathlib import Path

from pebble.config import LAUNCHER_LOCK
from pebble.ownership import read_plain


def launcher_runs(run_dir: Path) -> bool:
    """True if the last started launcher of this run directory is still running."""
    try:
        pid = int(read_plain(run_dir / LAUNCHER_LOCK).partition(b"\n")[0])
        os.kill(pid, 0)
    except (OSError, ValueError, OverflowError):
        return False
    return True
