"""Reads the description of a script: from its `script.json` or, for our scripts, by running it with `--describe`."""

import ast
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import msgspec
from msgspec import Struct

from pebble.config.text_files import NotTextError, text_of
from pebble.contract.payloads import LONGEST_SUMMARY, MOST_MAIN
from pebble.extensions.media.child import Child
from pebble.extensions.operator.client.forms import MAX_SETTINGS, Setting
from pebble.services.autonomy_manager.script import Dependency

MANIFEST = "script.json"
_LIMIT_S = 20.0
_LONGEST = 256 * 1024  # bytes of an answer or a `script.json`
_LONGEST_SOURCE = 1024 * 1024
_REASON_BYTES = 2000  # of what a failing script wrote
_NICE = "10"  # lower than the robot's own processes


class Description(Struct, frozen=True):
    """A script's description of itself; ``command`` only in a `script.json`.

    ``summary`` says in one sentence what it does; ``main`` are the keys of the settings that operators see first.
    ``drives`` is False for a script that only measures; that counts only in an answer to ``--describe``, because
    ``pebble.script`` then refuses to drive.
    """

    label: str | None = None
    summary: str = ""
    main: list[str] = []
    configs: list[Setting] = []
    dependencies: list[Dependency] = []
    command: list[str] = []
    drives: bool = True

    def __post_init__(self) -> None:
        if len(self.configs) > MAX_SETTINGS:
            raise ValueError(f"more than {MAX_SETTINGS} settings")
        if len(self.summary) > LONGEST_SUMMARY:
            raise ValueError(f"its summary is longer than {LONGEST_SUMMARY} characters")
        if len(self.main) > MOST_MAIN:
            raise ValueError(f"more than {MOST_MAIN} main settings")
        if not all(map(str.isprintable, _texts(self))):
            raise ValueError("its texts must not contain control characters")
        keys = [setting.key for setting in self.configs]
        if len(set(keys)) < len(keys):
            raise ValueError("two settings have the same key")


def _texts(description: Description) -> Iterator[str]:
    """Yield the texts that operators see, also in a terminal."""
    yield description.label or ""
    yield description.summary
    for setting in description.configs:
        options = map(str, setting.options)
        yield from (setting.key, setting.label or "", setting.arg or "", setting.arg_false or "", *options)


class DescribeError(Exception):
    """An error: a script has not described itself, so it is offered without settings. The text says why."""


class BrokenScriptError(DescribeError):
    """An error: a script cannot run at all, so it cannot be started. The text says why."""


def is_ours(entry: Path) -> bool:
    """True if a Python file imports ``run`` from pebble, or pebble.script. It is parsed, not run.

    Pipes and devices are not opened, as that could wait for ever. Raises BrokenScriptError for a file that is not valid
    Python.
    """
    if entry.suffix != ".py" or not entry.is_file():
        return False
    try:
        if entry.stat().st_size > _LONGEST_SOURCE:
            return False
        tree = ast.parse(entry.read_bytes())
    except SyntaxError as error:
        raise BrokenScriptError(f"{entry.name}, line {error.lineno or 1}: {_shown(error.msg)}") from None
    except (OSError, ValueError, RecursionError, MemoryError):
        return False
    return any(map(_imports_ours, ast.walk(tree)))


def _imports_ours(node: ast.AST) -> bool:
    if isinstance(node, ast.Import):
        return any(alias.name == "pebble.script" for alias in node.names)
    if isinstance(node, ast.ImportFrom) and node.level == 0:
        names = {alias.name for alias in node.names}
        return node.module == "pebble.script" or (node.module == "pebble" and not names.isdisjoint({"run", "script"}))
    return False


def read_manifest(path: Path) -> Description | None:
    """Return the description in a `script.json`; None without one. Raises DescribeError."""
    try:
        if path.exists() and not path.is_file():
            raise DescribeError(f"{MANIFEST} is no file")  # to open a pipe would wait for its other end
        with path.open("rb") as file:
            raw = file.read(_LONGEST + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DescribeError(f"{MANIFEST} cannot be read: {error.strerror}") from None
    return _parse(raw, MANIFEST)


def ask(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Description:
    """Run ``command --describe``, at most 20 s; return the description. Raises DescribeError."""
    return _parse(answer_of((*command, "--describe"), folder, environment, "its --describe"), "its --describe")


def answer_of(command: Sequence[str], folder: Path, environment: Mapping[str, str], name: str = "it") -> bytes:
    """Run ``command``, at most 20 s; return its output. Raises DescribeError."""
    limited = ["nice", "-n", _NICE, "prlimit", f"--fsize={_LONGEST + 1}", *command]
    with TemporaryFile() as output, TemporaryFile() as errors:
        try:
            process = Child(limited, environment, folder, stdout=output, stderr=errors)
        except (OSError, ValueError) as error:
            raise DescribeError(f"cannot be asked: {error}") from None
        code = process.wait(_LIMIT_S)
        process.finish(0.0)
        if code is None:
            raise DescribeError(f"{name} takes longer than {_LIMIT_S:g} s")
        answer, reason = _content(output), _content(errors)[-_REASON_BYTES:].decode(errors="replace")
    if code != 0:
        last = reason.strip().rpartition("\n")[2]
        why = f": {_shown(last[:300])}" if last else ""
        raise BrokenScriptError(f"{name} ended with code {code}{why}")
    return answer


def _shown(text: str) -> str:
    """Return a text without terminal control characters, fit for a log."""
    return "".join(letter for letter in text if letter.isprintable())


def _content(file: IO[bytes]) -> bytes:
    file.seek(0)
    return file.read(_LONGEST + 1)


def _parse(raw: bytes, source: str) -> Description:
    """Return the description in a `script.json`, or in an output's last line: modules may print lines before it."""
    if len(raw) > _LONGEST:
        raise DescribeError(f"{source} is longer than {_LONGEST} bytes")
    try:
        text = text_of(raw) if source == MANIFEST else raw.strip().rpartition(b"\n")[2]
        return msgspec.json.decode(text, type=Description)
    except (msgspec.DecodeError, ValueError, RecursionError, NotTextError) as error:
        raise DescribeError(f"{source}: {error}") from None


def stamp(file: Path) -> tuple[int, int] | None:
    """Return a value that changes with the file; None if there is no file."""
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
