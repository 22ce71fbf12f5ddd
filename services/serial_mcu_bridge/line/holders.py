"""Who else has a serial device open: both read what the board sends, so each misses some, and both send."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_OTHER_END = "/ptmx"  # of a pty: it is the board itself, a simulated one
_PROCESSES = Path("/proc")


def holders(path: str) -> list[str]:
    """Return the other processes that have this device open, as far as this user may see them.

    Example: ``process 812 (python3) of pebble-control.service``.
    """
    device = os.path.realpath(path)
    return [_named(process) for process in _others() if _has_open(process, device)]


def _others() -> Iterator[Path]:
    with suppress(OSError):
        for process in _PROCESSES.iterdir():
            if process.name.isdigit() and int(process.name) != os.getpid():
                yield process


def _has_open(process: Path, device: str) -> bool:
    files = set()
    with suppress(OSError):  # it has ended, or is another user's
        for number in os.listdir(process / "fd"):  # noqa: PTH208 - a Path for each is slow
            with suppress(OSError):
                files.add(os.readlink(f"{process}/fd/{number}"))  # noqa: PTH115
    return device in files and not any(file.endswith(_OTHER_END) for file in files)


def _named(process: Path) -> str:
    name, unit = _text(process / "comm"), _text(process / "cgroup").rpartition("/")[2]
    return f"process {process.name} ({name})" + (f" of {unit}" if unit.endswith(".service") else "")


def _text(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return "".join(letter if letter.isprintable() else " " for letter in text)
