"""Finds other programs that use a serial device. Of two programs neither reads all bytes, and both send."""

import os
from contextlib import suppress
from pathlib import Path

_PTY_MASTER = "/ptmx"  # the other end of a pty: the process that has it simulates the board


def holders(path: str) -> list[str]:
    """Return the other processes that have this device open, as far as this user may see them.

    Example: ``process 812 (python3) of pebble-control.service``.
    """
    device, others = os.path.realpath(path), []
    for process in Path("/proc").glob("[1-9]*"):
        files = set()
        with suppress(OSError):  # it has ended, or is another user's
            for number in os.listdir(process / "fd"):  # noqa: PTH208 - a Path for each is slow
                with suppress(OSError):
                    files.add(os.readlink(f"{process}/fd/{number}"))  # noqa: PTH115
        is_simulator = any(file.endswith(_PTY_MASTER) for file in files)  # it has the board's end of a pty
        if device in files and process.name != str(os.getpid()) and not is_simulator:
            with suppress(OSError):
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
                unit = (process / "cgroup").read_text(encoding="utf-8").strip().rpartition("/")[2]
                of_unit = f" of {unit}" if unit.endswith(".service") else ""
                others.append(f"process {process.name} ({name}){of_unit}")
    return others
