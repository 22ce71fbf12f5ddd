"""The Python that runs a script, and what a script that does not import pebble lacks there."""

import ast
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from pebble.services.autonomy_manager.describe import DescribeError, answer_of

SYSTEM = Path("/usr/bin/python3")  # has what Debian's packages install, such as an OpenCV with GStreamer
_PARENTS = 3  # folders above a script from which it may import: scripts of the original do from two above
_GSTREAMER = "cv2 with GStreamer"
_PROBE = """
import sys
del sys.path[0]  # the folder of the script: a check runs nothing of it
import importlib.util
for name in sys.argv[1:]:
    there = importlib.util.find_spec(name.partition(" ")[0])
    if there and " " in name:
        import cv2
        there = any("GStreamer" in line and "YES" in line for line in cv2.getBuildInformation().splitlines())
    if not there:
        print(name)
"""


def interpreter(configured: str | None, *, ours: bool) -> str:
    """Return the Python of a script: the configured one, else ours for one of ours, and the system's for others."""
    return configured or (sys.executable if ours or not SYSTEM.is_file() else str(SYSTEM))


def lacking(command: Sequence[str], folder: Path, variables: Mapping[str, str]) -> list[str]:
    """Return the modules that a script imports at its beginning and its Python does not find. It is read, not run.

    Nothing is known of what is no Python file. One that changes ``sys.path`` may find more.
    """
    entry = Path(command[-1])
    try:
        text = entry.read_bytes() if entry.suffix == ".py" else b""
        names = {name.partition(".")[0]: None for node in ast.parse(text).body for name in _imported(node)}
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return []
    places = (entry.parent, *entry.parent.parents[:_PARENTS])
    wanted = [name for name in names if name not in sys.stdlib_module_names and not _is_in(places, name)]
    if "cv2" in wanted and b"shmsrc" in text:
        wanted.append(_GSTREAMER)
    try:
        found = answer_of((command[0], "-c", _PROBE, *wanted), folder, variables) if wanted else b""
    except DescribeError as error:
        return [str(error)]
    return found.decode().splitlines()


def _imported(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module] if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module else []


def _is_in(places: Sequence[Path], name: str) -> bool:
    return any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
