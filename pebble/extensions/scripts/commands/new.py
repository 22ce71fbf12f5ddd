"""A first script for a new user, which follows a tag, with its test and its robot in a simulated room."""

import re
import tempfile
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

from pebble.errors import PebbleError
from pebble.runtime.as_owner import as_owner

_name = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,62}").fullmatch


def write(name: str, folder: Path) -> Iterator[Path]:
    """Create ``folder/name`` with its files; yield their paths. Raises PebbleError if it exists."""
    if not _name(name):
        raise PebbleError(f"{name!r}: a script's name is letters, digits, - and _, beginning with a letter")
    target = folder / name
    try:
        if (alike := _alike(target)) is not None:
            raise PebbleError(f"{alike} exists already: choose another name, or another --folder")
        with as_owner(folder):
            target.mkdir(parents=True)
    except OSError as error:
        raise PebbleError(f"{target}: {error.strerror}") from None
    test = f"test_{name.replace('-', '_')}.py"
    texts = {
        "run.py": _text("run.py.txt"),
        test: _text("test_run.py.txt"),
        "room.json": files("pebble.extensions.lab.simulation.world").joinpath("room.json").read_text(encoding="utf-8"),
        "goob.json": _robot(target),
        "pytest.ini": _text("pytest.ini"),
    }
    for file, text in texts.items():
        with as_owner(target):
            (target / file).write_text(text, encoding="utf-8")
        yield target / file


def _alike(target: Path) -> Path | None:
    """Return an existing path that differs only in case, which many file systems ignore; else None."""
    if not target.parent.is_dir():
        return None
    return next((path for path in target.parent.iterdir() if path.name.lower() == target.name.lower()), None)


def _text(file: str) -> str:
    return files("pebble.extensions.scripts.commands").joinpath("starter", file).read_text(encoding="utf-8")


def _robot(target: Path) -> str:
    """Return the robot's config, with absolute paths so that `pebble up` works in every folder."""
    world = Path(tempfile.gettempdir(), "pebble-world-room")
    return _text("goob.json").replace("{folder}", str(target.absolute())).replace("{world}", str(world))
