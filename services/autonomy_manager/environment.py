"""The Python of a script, its environment variables, and the modules that it lacks."""

import ast
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pebble.config import Config
from pebble.extensions.scripts.runs import CONFIG, RUN
from pebble.runtime.environment import child_environment
from pebble.services.autonomy_manager.describe import DescribeError, answer_of

SYSTEM = Path("/usr/bin/python3")  # has what Debian's packages install, such as an OpenCV with GStreamer
_PARENTS = 3  # folders above a script from which it may import: scripts of the original do from two above
_LONGEST = 1 << 20  # bytes of a file that is read
_PROBE = """
import sys
del sys.path[0]  # the folder of the script: a check runs nothing of it
from importlib.util import find_spec
print(*(name for name in sys.argv[1:] if not find_spec(name)))
"""


def interpreter(configured: str | None, *, ours: bool) -> str:
    """Return the Python for a script: the configured one, else ours for our scripts, the system's for others."""
    return configured or (sys.executable if ours or not SYSTEM.is_file() else str(SYSTEM))


def environment(*more: Mapping[str, str], ours: bool = True) -> dict[str, str]:
    """Return this process's variables with ``more`` added.

    For foreign scripts (``ours`` False) ``python3`` is the system's, even if Pebble's comes first in PATH.
    """
    merged = {"PYTHONUNBUFFERED": "1"}  # else what it prints comes in blocks, long after
    merged |= child_environment()
    for name in (RUN, CONFIG):  # which run and which robot: only ``more`` says that
        merged.pop(name, None)
    if not ours and sys.prefix != sys.base_prefix and SYSTEM.is_file():
        pebbles = str(Path(sys.prefix, "bin"))
        places = merged.get("PATH", "").split(os.pathsep)
        others = [place for place in places if place != pebbles]
        merged["PATH"] = os.pathsep.join(others + [place for place in places if place == pebbles])
        merged.pop("VIRTUAL_ENV", None)
    for variables in more:
        merged |= variables
    return merged


def local_login(config: Config) -> dict[str, str]:
    """Return the variable with the password of the robot's own broker, for a script that connects by itself."""
    local = config.local_mqtt
    if config.transport.kind != "mqtt" or local.password_env is None:
        return {}
    return {local.password_env: str(local.password or "")}


def lacking(command: Sequence[str], folder: Path, variables: Mapping[str, str]) -> list[str]:
    """Return the modules that a script imports at its beginning and that its Python does not find.

    The script is read, not run, and so are the files beside it that it names. Nothing is known about a script that is
    no Python file. A script that changes ``sys.path`` may find more modules.
    """
    entry = next((folder / word for word in command[1:] if word.endswith(".py")), None)
    if entry is None:
        return []
    text = _read(entry)
    beside = [path for path in sorted(entry.parent.glob("*.py")) if path != entry and path.stem.encode() in text]
    names = {name: None for source in (text, *map(_read, beside)) for name in _imported(source)}
    places = (entry.parent, *entry.parent.parents[:_PARENTS])
    wanted = [name for name in names if name not in sys.stdlib_module_names and not _is_in(places, name)]
    try:
        answer = answer_of((command[0], "-c", _PROBE, *wanted), folder, variables) if wanted else b""
    except DescribeError as error:
        return [str(error)]
    return answer.decode().split()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes() if path.is_file() and path.stat().st_size <= _LONGEST else b""
    except OSError:
        return b""


def _imported(text: bytes) -> Iterator[str]:
    """Yield the top-level names of the modules that a file imports at its beginning; nothing if it is no Python."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0]


def _is_in(places: Sequence[Path], name: str) -> bool:
    return any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
