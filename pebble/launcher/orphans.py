"""Collects the processes that others leave to the launcher where it is process 1, as in a container."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path


def reap(own: Collection[int]) -> int:
    """Collect children that have ended, except those in ``own``: their supervisors do that. Returns how many.

    The kernel gives process 1 whatever process loses its parent. Nothing else waits for these, and each would hold its
    number until the container has none left.
    """
    collected = 0
    with suppress(OSError):  # a kernel that lists no children
        for pid in map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="utf-8").split()):
            if pid not in own:
                with suppress(ChildProcessError):
                    collected += os.waitpid(pid, os.WNOHANG)[0] == pid
    return collected
