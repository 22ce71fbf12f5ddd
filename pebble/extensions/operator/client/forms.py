"""The form of a script: its settings, and the values that they accept. Pure.

Used by the manager that starts scripts, by scripts, and by operators' programs (paper A.8.11).
"""

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from typing import Any, Literal

from msgspec import Struct, ValidationError, convert

MAX_SETTINGS = 64  # of one script
MAX_TEXT = 256  # characters of a value

_TYPES = ("string", "int", "float", "bool", "enum")
_SHOWN = 100  # characters of a refused value
_TRUE = frozenset(("1", "true", "yes", "on", "enabled", "enable"))
_FALSE = frozenset(("0", "false", "no", "off", "disabled", "disable"))
_FILE_WORDS = frozenset(("file", "filename", "path", "dir", "directory", "folder"))
_integer = re.compile(r"\s*[+-]?\d{1,15}\s*", re.ASCII).fullmatch
_number = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII).fullmatch

Value = str | int | float | bool | None


class SettingError(ValueError):
    """An error: a setting does not accept a value. The text is for the sender of the value."""


class Setting(Struct, frozen=True, kw_only=True):
    """A setting: an entry of ``configs`` in `autonomy-files`, and an option of the script's command line."""

    key: str
    label: str | None = None
    type: Literal["string", "int", "float", "bool", "enum"] = "string"
    default: Value = None
    arg: str | None = None
    required: bool = False
    min: int | float | None = None
    max: int | float | None = None
    step: int | float | None = None
    options: Sequence[Value] = ()
    mode: Literal["flag", "value"] | None = None
    arg_false: str | None = None

    @property
    def names_file(self) -> bool:
        """True if the setting's value is a path, which a command must not choose on the robot."""
        words = re.split(r"[^a-z]+", f"{self.key} {self.arg or ''}".lower())
        free_text = self.type == "string" or (self.type == "enum" and not self.options)
        return free_text and not _FILE_WORDS.isdisjoint(words)

    def entry(self) -> dict[str, Any]:
        """Return the setting as an entry of ``configs``."""
        entry: dict[str, Any] = {
            "key": self.key,
            "label": self.label or self.key,
            "type": self.type,
            "default": self.default,
            "arg": self.arg or "",
        }
        if self.required:
            entry["required"] = True
        if self.type in ("int", "float"):
            limits = {"min": self.min, "max": self.max, "step": self.step}
            entry |= {name: limit for name, limit in limits.items() if limit is not None}
        if self.type == "enum" and self.options:
            entry["options"] = [str(option) for option in self.options]
        entry |= {name: value for name, value in (("mode", self.mode), ("arg_false", self.arg_false)) if value}
        return entry


def listed(configs: object) -> list[Setting]:
    """Return the settings that a robot lists for a script.

    Invalid entries are left out; an unknown type counts as text.
    """
    settings: list[Setting] = []
    for entry in configs if isinstance(configs, list) else ():
        with suppress(ValidationError, TypeError, KeyError):
            kind = entry["type"] if entry["type"] in _TYPES else "string"
            settings.append(convert({**entry, "type": kind}, Setting))
    return settings


def form(settings: Sequence[Setting]) -> list[dict[str, Any]]:
    """Return the settings that operators may change."""
    return [setting.entry() for setting in settings if not setting.names_file]


def effective(settings: Sequence[Setting], wanted: Mapping[str, Any]) -> dict[str, Value]:
    """Return each setting's wanted value, or its default. Raises SettingError.

    Wanted values of unknown settings, and of settings that name a file, are ignored.
    """
    values: dict[str, Value] = {}
    for setting in settings:
        raw = setting.default if setting.names_file else wanted.get(setting.key, setting.default)
        if raw is None and setting.required:
            raise SettingError(f"Missing required config field '{setting.key}'")
        raw = setting.default if raw is None else raw
        values[setting.key] = None if raw is None else accepted(setting, raw)
    return values


def arguments(settings: Sequence[Setting], values: Mapping[str, Value]) -> list[str]:
    """Return the command line for the effective ``values``; option and value are separate words."""
    words: list[str] = []
    for setting in settings:
        value = values[setting.key]
        if value is None or not setting.arg:
            continue
        if setting.type == "bool" and setting.mode != "value":
            flag = setting.arg if value else setting.arg_false
            words += [flag] if flag else []
        else:
            words += [setting.arg, _word(value)]
    return words


def accepted(setting: Setting, raw: Any) -> Value:
    """Return the setting's value for ``raw``, from JSON or from a command line. Raises SettingError."""
    match setting.type:
        case "bool":
            return _bool(setting.key, raw)
        case "int" | "float":
            return _in_range(setting, _numeric(setting, raw))
        case "enum" if setting.options:
            return _option(setting, raw)
    return _text(setting.key, raw)


def _bool(key: str, raw: Any) -> bool:
    word = str(raw).strip().lower() if isinstance(raw, bool | int | str) else ""
    if word not in _TRUE | _FALSE:
        raise SettingError(f"{key} must be true or false")
    return word in _TRUE


def _numeric(setting: Setting, raw: Any) -> int | float:
    """Return a number, or a text that is one, in the setting's type: int or float. Raises SettingError."""
    is_integer = setting.type == "int"
    error = SettingError(f"{setting.key} must be a {'whole ' if is_integer else ''}number")
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        raise error
    if isinstance(raw, str):
        matches = _integer if is_integer else _number
        if not matches(raw):
            raise error
        return int(raw) if is_integer else _finite(setting.key, raw)
    number = _finite(setting.key, raw)
    if not is_integer:
        return number
    if not number.is_integer() or abs(number) >= 1e15:  # 15 digits, as in a text
        raise error
    return int(raw)


def _finite(key: str, raw: float | str) -> float:
    try:
        number = float(raw)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SettingError(f"{key} must be a finite number")
    return number


def _in_range(setting: Setting, number: int | float) -> int | float:
    if setting.min is not None and number < setting.min:
        raise SettingError(f"{setting.key} below minimum {setting.min}")
    if setting.max is not None and number > setting.max:
        raise SettingError(f"{setting.key} above maximum {setting.max}")
    return number


def _option(setting: Setting, raw: Any) -> str:
    if str(raw) not in map(str, setting.options):
        raise SettingError(f"Invalid option '{shown(raw)}' for {setting.key}")
    return str(raw)


def _text(key: str, raw: Any) -> str:
    """Return a word for the command line that does not look like an option."""
    if isinstance(raw, bool) or not isinstance(raw, str | int | float):
        raise SettingError(f"{key} must be text")
    text = str(raw)
    if text.startswith("-"):
        raise SettingError(f"{key} must not begin with '-'")
    if len(text) > MAX_TEXT:
        raise SettingError(f"{key} is longer than {MAX_TEXT} characters")
    if not text.isprintable():
        raise SettingError(f"{key} must not contain control characters")
    return text


def shown(raw: object) -> str:
    """Return a command's text in a form fit for a status and a log."""
    return "".join(letter if letter.isprintable() else "?" for letter in str(raw)[:_SHOWN])


def _word(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and "e" in repr(value):
        return format(Decimal(repr(value)), "f")  # argparse takes -1e-05 for an option
    return str(value)
