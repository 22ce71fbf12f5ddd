"""From a config file's bytes to plain data: JSON with `//` keys as comments, and nothing JSON does not allow."""

import json
import math
from pathlib import Path
from typing import Any

from pebble.config import problems
from pebble.errors import ConfigError


class Pairs(list[tuple[str, Any]]):
    """A JSON object as it was written: in order, and with the keys that occur twice."""


def read_text(path: Path) -> str:
    """The file's text. Raises ConfigError, naming the file, when it cannot be had."""
    try:
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder, name the JSON file in it")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text, see its byte {error.start}") from None


def decode(text: str, name: str) -> Any:
    """Parse JSON, objects as Pairs. Raises ConfigError with line and column; ``name`` is the file's for messages."""
    try:
        return json.loads(text, object_pairs_hook=Pairs)
    except json.JSONDecodeError as error:
        place = f"{name}: line {error.lineno}, column {error.colno}"
        raise ConfigError(f"{place}: not JSON: {error.msg}{_hint(text, error.pos)}") from None
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply") from None
    except ValueError as error:  # a number of thousands of digits
        raise ConfigError(f"{name}: not JSON: {error}") from None


def _hint(text: str, position: int) -> str:
    rest, before = text[position:].lstrip(), text[:position].rstrip()
    if rest[:1] in ("}", "]") and before.endswith(","):
        return "; leave out the comma before it"
    if rest.startswith(("//", "/*", "#")):
        return '; a comment is a key that starts with //, such as {"// why": "because"}'
    return ""


def plain(raw: Any, notes: problems.Notes, path: problems.Path = ()) -> Any:
    """Make ``raw`` plain data: comments left out; repeated keys and values that JSON does not know are problems."""
    if isinstance(raw, dict):
        raw = Pairs(raw.items())
    if isinstance(raw, Pairs):
        return _object(raw, notes, path)
    if isinstance(raw, list):
        return [plain(item, notes, (*path, index)) for index, item in enumerate(raw)]
    if isinstance(raw, float) and not math.isfinite(raw):
        notes.problem(path, f"must be a number, not {raw}")
        return None
    if isinstance(raw, str) and not _encodable(raw):
        notes.problem(path, "holds half a character (a lone surrogate), which nothing can write")
        return None
    return raw


def _object(pairs: Pairs, notes: problems.Notes, path: problems.Path) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, value in pairs:
        if key.startswith("//"):
            continue
        if key in data:
            notes.problem((*path, key), "occurs twice in one object, leave one of them")
        data[key] = plain(value, notes, (*path, key))
    return data


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
