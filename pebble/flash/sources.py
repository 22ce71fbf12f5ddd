"""Which files of firmware/ a robot needs, and how they are compiled."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

from pebble.errors import PebbleError
from pebble.flash.boards import Firmware


def firmware_folder() -> Path:
    """firmware/ of the checkout or of the installed package."""
    return Path(str(files("pebble"))) / "firmware"


def main_file(firmware: Firmware, root: Path | None = None) -> Path:
    """What becomes /main.py on the board."""
    return (root or firmware_folder()) / firmware.name / "main.py"


def modules(firmware: Firmware, root: Path | None = None) -> list[Path]:
    """All files that main.py needs, directly or not, relative to firmware/; raises PebbleError if there are none.

    A board has little room, so nothing else is copied.
    """
    root = root or firmware_folder()
    main = main_file(firmware, root)
    if not main.is_file():
        raise PebbleError(f"{firmware.name} has no firmware yet: there is no {main}")
    found: set[Path] = set()
    waiting = [main]
    while waiting:
        for path in _imported(waiting.pop(), root):
            if path not in found:
                found.add(path)
                waiting.append(root / path)
    return sorted(found)


def _imported(file: Path, root: Path) -> Iterator[Path]:
    for node in ast.walk(ast.parse(file.read_text(), file.name)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            path = Path(*name.split(".")).with_suffix(".py")
            if (root / path).is_file():  # else MicroPython's own
                yield path


def compile_command(firmware: Firmware, module: Path, root: Path, target: Path) -> list[str]:
    """mpy-cross's arguments: ``module`` into ``target``/same/path.mpy.

    What tracebacks call the file is the module's name: MicroPython keeps that one in memory anyway.
    """
    level = "-O2" if firmware.board.roomy else "-O3"  # both leave out asserts, the latter line numbers too
    return [
        f"-march={firmware.board.arch}",
        level,
        "-s",
        ".".join(module.with_suffix("").parts),
        "-o",
        str(target / module.with_suffix(".mpy")),
        str(root / module),
    ]
