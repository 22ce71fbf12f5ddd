"""Reads a config file as plain data: JSON without comments. Serial lines inherit the keys of their section."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pebble.config import problems, text_files
from pebble.config.visible import hidden, shown
from pebble.errors import ConfigError
from pebble.extension import value_at

#: Keys below which texts may begin or end with blanks: commands, values of variables, and words for people.
_WORDS = ("command", "player_command", "env", "robots", "robot_discovery")
#: Objects whose keys are names that the owner chose, which may begin with _.
_OF_NAMES = ("env", "instances", "scripts", "extensions", "aliases", "settings", "camera_controls")
_DEEPEST = 50  # levels: far more than any section has, and few enough for later readers


class Pairs(list[tuple[str, Any]]):
    """A JSON object as written: in order, and with repeated keys."""


def read_text(path: Path) -> str:
    """Return the file's text. Raises ConfigError, naming the file, when it cannot be read."""
    try:
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder, name the JSON file in it")
        return text_files.read_text(path)
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except text_files.NotTextError as error:
        raise ConfigError(f"{path}: {error}") from None


def decode(text: str, name: str) -> Any:
    """Parse JSON, objects as Pairs. Raises ConfigError with line and column in the file ``name``."""
    try:
        return json.loads(text, object_pairs_hook=Pairs)
    except json.JSONDecodeError as error:
        place = f"{name}: line {error.lineno}, column {error.colno}"
        raise ConfigError(f"{place}: not JSON: {error.msg}") from None
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply") from None
    except ValueError as error:  # a number of thousands of digits
        raise ConfigError(f"{name}: not JSON: {error}") from None


def plain(raw: Any, notes: problems.Notes, path: problems.Path = ()) -> Any:
    """Return ``raw`` as plain data, without comments. Repeated keys and invalid values are noted as problems."""
    if len(path) > _DEEPEST:
        notes.problem(path[:2], f"is nested more than {_DEEPEST} levels deep")
        return None
    if isinstance(raw, dict):  # made by a program, not by `decode`
        raw = Pairs(raw.items())
    if isinstance(raw, Pairs):
        return _object(raw, notes, path)
    if isinstance(raw, list):
        return [plain(item, notes, (*path, index)) for index, item in enumerate(raw)]
    if isinstance(raw, float) and not math.isfinite(raw):
        notes.problem(path, f"must be a number, not {raw}")
        return None
    if isinstance(raw, str) and (flaw := hidden(raw, words=_is_words(path))):  # not shown, or a blank at an end
        notes.problem(path, flaw)
        return ""
    return raw


def _object(pairs: Pairs, notes: problems.Notes, path: problems.Path) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, value in pairs:
        if key.startswith("//") or (key.startswith("_") and not (path and path[-1] in _OF_NAMES)):
            continue  # a comment; but in _OF_NAMES the owner chooses the names, and _ may begin one
        if flaw := hidden(key):
            notes.problem(path, f'has a key "{shown(key)}" that {flaw}')
            continue
        if key in data:
            notes.problem((*path, key), "occurs twice in one object, leave one of them")
        data[key] = plain(value, notes, (*path, key))
    return data


def _is_words(path: problems.Path) -> bool:
    """True if the text at ``path`` may begin or end with blanks."""
    return "topics" not in path and any(key in _WORDS for key in path)


def deep_merge(under: Any, over: Any) -> Any:
    """Return ``under`` updated by ``over``, objects key by key, over's keys first. "" and null change nothing."""
    if over is None or over == "":
        return under
    if not isinstance(under, dict) or not isinstance(over, dict):
        return over
    merged = {key: deep_merge(under.get(key), value) for key, value in over.items()}
    return merged | {key: value for key, value in under.items() if key not in over}  # problems come in this order


def with_instances(raw: Any) -> Any:
    """Return ``raw`` with the keys of the section ``serial_mcu_bridge`` copied to each of its instances."""
    serial = value_at(raw, "services", "serial_mcu_bridge")
    instances = value_at(serial, "instances")
    if not isinstance(instances, dict):
        return raw
    shared = {key: value for key, value in serial.items() if key != "instances"}
    merged = {name: deep_merge(shared, instance) for name, instance in instances.items()}
    return raw | {"services": raw["services"] | {"serial_mcu_bridge": shared | {"instances": merged}}}


def without(raw: Any, keys: Iterable[str]) -> Any:
    """Return ``raw`` without the values at these dotted keys."""
    for key in keys:
        first, _, key_below = key.partition(".")
        value = raw.get(first) if isinstance(raw, dict) else None
        if key_below and isinstance(value, dict):
            raw = raw | {first: without(value, [key_below])}
        elif not key_below and value is not None:
            raw = {name: other for name, other in raw.items() if name != first}
    return raw
