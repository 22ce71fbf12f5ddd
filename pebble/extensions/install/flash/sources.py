"""Finds the files of firmware/ that a robot needs, and the command that compiles each."""

import ast
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import Firmware


def firmware_folder() -> Path:
    """Return the folder firmware/ of the checkout or of the installed package."""
    return Path(str(files("pebble"))) / "firmware"


def main_file(firmware: Firmware, root: Path | None = None) -> Path:
    """Return the file that is installed as /main.py on the board."""
    return (root or firmware_folder()) / firmware.name / "main.py"


def modules(firmware: Firmware, root: Path | None = None) -> list[Path]:
    """Return all modules that main.py imports, also indirectly, relative to firmware/; only these are copied.

    Raises PebbleError if there is no main.py.
    """
    root = root or firmware_folder()
    main = main_file(firmware, root)
    if not main.is_file():
        raise PebbleError(f"{firmware.name} has no firmware yet: {main} does not exist")
    imported: set[Path] = set()
    waiting = [main]
    while waiting:
        for path in _imported(waiting.pop(), root):
            if path not in imported:
                imported.add(path)
                waiting.append(root / path)
    return sorted(imported)


def _imported(file: Path, root: Path) -> Iterator[Path]:
    """Yield the files of firmware/ that a file imports, relative to ``root``."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), file.name)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            path = Path(*name.split(".")).with_suffix(".py")
            if (root / path).is_file():  # else it is built into MicroPython
                yield path


def compile_command(firmware: Firmware, module: Path, root: Path, target: Path) -> list[str]:
    """Return mpy-cross's arguments that compile ``module`` into ``target``/same/path.mpy.

    Tracebacks show the module's name instead of a path: MicroPython holds that name in memory anyway.
    """
    level = "-O2" if firmware.board.has_much_memory else "-O3"  # both omit asserts, -O3 line numbers too
    return [
        f"-march={firmware.board.arch}",
        level,
        "-s",
        ".".join(module.with_suffix("").parts),
        "-o",
        str(target / module.with_suffix(".mpy")),
        str(root / module),
    ]
