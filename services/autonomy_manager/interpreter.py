"""Finds the Python that runs a script, and the modules that it lacks."""

import ast
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pebble.services.autonomy_manager.describe import DescribeError, answer_of

SYSTEM = Path("/usr/bin/python3")  # has what Debian's packages install, such as an OpenCV with GStreamer
_PARENTS = 3  # folders above a script from which it may import: scripts of the original do from two above
_MOST_FILES, _LONGEST = 20, 1 << 20  # of a script's folder that are read; bytes of one
_GSTREAMER = "cv2 with GStreamer"
_OLD_NUMPY = "numpy below 2.4 (float() of an array)"
_ARRAYS = ("cv2", "numpy")  # whose names are looked for one by one: newer releases lack some
_PROBE = """
import sys
del sys.path[0]  # the folder of the script: a check runs nothing of it
import importlib, importlib.util
def has(want):
    name, _, more = want.partition(" ")
    top, *parts = name.split(".")
    if not importlib.util.find_spec(top):
        return bool(parts or more)
    if not parts and not more:
        return True
    found = importlib.import_module(top)
    if "GStreamer" in more:
        return any("GStreamer" in line and "YES" in line for line in found.getBuildInformation().splitlines())
    if "below" in more:
        return tuple(map(int, found.__version__.split(".")[:2])) < (2, 4)
    for part in parts:
        found = getattr(found, part, None)
    return found is not None
for want in sys.argv[1:]:
    if not has(want):
        print(want)
"""


def interpreter(configured: str | None, *, ours: bool) -> str:
    """Return the Python for a script: the configured one, else ours for our scripts, the system's for others."""
    return configured or (sys.executable if ours or not SYSTEM.is_file() else str(SYSTEM))


def lacking(command: Sequence[str], folder: Path, variables: Mapping[str, str]) -> list[str]:
    """Return the modules that a script imports at its beginning and that its Python does not find.

    The script is read, not run, and so are the files beside it that it names. The result also has functions of OpenCV
    and NumPy that it calls and that newer releases lack. Nothing is known about a script that is no Python file. A
    script that changes ``sys.path`` may find more modules.
    """
    entry = next((folder / word for word in command[1:] if word.endswith(".py")), None)
    if entry is None:
        return []
    names: dict[str, None] = {}
    needs: dict[str, None] = {}
    for text in _sources(entry):
        try:
            tree = ast.parse(text)
            imported = [name.partition(".")[0] for node in tree.body for name in _imported(node)]
            if not set(imported).isdisjoint(_ARRAYS):
                needs |= dict.fromkeys(_needs(tree, text))
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            continue
        names |= dict.fromkeys(imported)
    places = (entry.parent, *entry.parent.parents[:_PARENTS])
    wanted = [name for name in names if name not in sys.stdlib_module_names and not _is_in(places, name)]
    wanted += needs
    try:
        answer = answer_of((command[0], "-c", _PROBE, *wanted), folder, variables) if wanted else b""
    except DescribeError as error:
        return [str(error)]
    return answer.decode().splitlines()


def _sources(entry: Path) -> Iterator[bytes]:
    """Yield the text of a script, and of the files beside it that it names."""
    try:
        text = _read(entry)
        yield text
        beside = [path for path in sorted(entry.parent.glob("*.py")) if path != entry and path.stem.encode() in text]
        yield from map(_read, beside[:_MOST_FILES])
    except OSError:
        return


def _read(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() and path.stat().st_size <= _LONGEST else b""


def _needs(tree: ast.Module, text: bytes) -> Iterator[str]:
    """Yield what the script uses of OpenCV and NumPy that some releases or builds of them lack."""
    if b"shmsrc" in text:
        yield _GSTREAMER
    if re.search(rb"\bfloat\((?!\s*[\"'\d])|\bmap\(float\b", text):  # perhaps of an array, which NumPy 2.4 refuses
        yield _OLD_NUMPY
    if re.search(rb"\bhasattr\(|\bAttributeError\b", text):
        return  # the script itself finds out which names there are
    full_names: dict[str, str] = {}  # of all that is imported, by the names that the script uses for it
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            full_names |= {alias.asname or alias.name.partition(".")[0]: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            full_names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            name, _, attribute = ast.unparse(node).partition(".")
            if full_names.get(name, "").partition(".")[0] in _ARRAYS:
                yield f"{full_names[name]}.{attribute}"


def _imported(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module] if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module else []


def _is_in(places: Sequence[Path], name: str) -> bool:
    return any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
