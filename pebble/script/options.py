"""A script's options: a msgspec Struct becomes the form that operators see, and a command line becomes the Struct.

The entries of a form are those of the contract's autonomy-files (paper A.8.11).
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import typing
from collections.abc import Callable
from typing import Any, Literal, NoReturn, TypeVar

import msgspec
from msgspec import NODEFAULT, inspect

Options = TypeVar("Options", bound=msgspec.Struct)
Entry = dict[str, Any]

_KINDS: dict[type[inspect.Type], str] = {
    inspect.BoolType: "bool",
    inspect.IntType: "int",
    inspect.FloatType: "float",
    inspect.StrType: "string",
    inspect.LiteralType: "enum",
}
_NOUNS = {"int": "a whole number", "float": "a number", "string": "a text", "enum": "a choice"}
_RESERVED = ("config", "describe", "help")  # options that every script has
_whole = re.compile(r"[+-]?\d+", re.ASCII).fullmatch


def form(options: type[msgspec.Struct]) -> list[Entry]:
    """One entry per field. Raises TypeError that names the field and what to write instead."""
    hints = typing.get_type_hints(options)
    entries = [_entry(field, hints[field.name]) for field in inspect.type_info(options).fields]  # type: ignore[attr-defined]
    words = [entry[word] for entry in entries for word in ("arg", "arg_false") if word in entry]
    for word in words:
        if words.count(word) > 1 or word.removeprefix("--") in _RESERVED:
            raise TypeError(f"option {word.removeprefix('--')}: {word} means something else already: rename the field")
    return entries


def parse(
    options: type[Options], arguments: list[str], parser: argparse.ArgumentParser
) -> tuple[Options, argparse.Namespace]:
    """The Struct that these words of a command line describe, and the values of all options of ``parser``.

    Words that are wrong end the process with exit code 2 and one line on stderr.
    """
    entries = form(options)
    for entry in entries:
        _add(parser, entry)
    namespace = parser.parse_args(_joined(arguments, entries))
    values = vars(namespace)
    given = {entry["key"]: values[entry["key"]] for entry in entries if values[entry["key"]] is not None}
    try:
        return msgspec.convert(given, options), namespace
    except msgspec.ValidationError as error:
        parser.error(str(error))


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and whose options are written out."""

    def __init__(self, *, prog: str, description: str = "") -> None:
        super().__init__(prog=prog, description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        sys.stderr.write(f"{self.prog}: {message} (see --help)\n")
        raise SystemExit(2)


# -- a field becomes an entry


def _entry(field: inspect.Field, hint: Any) -> Entry:
    kind, meta, optional = _plain(field.type, field.name)
    name = field.encode_name
    flag = meta.get("arg", name.replace("_", "-"))
    type_ = _kind(kind, field.name)
    entry: Entry = {
        "key": name,
        "label": meta.get("title", name.replace("_", " ").capitalize()),
        "type": type_,
        "default": _default(field, type_),
        "arg": f"--{flag}",
    }
    if field.required or meta.get("required"):
        entry["required"] = True
    for bound, key in (("ge", "min"), ("le", "max")):
        if getattr(kind, bound, None) is not None:
            entry[key] = getattr(kind, bound)
    if "step" in meta:
        entry["step"] = meta["step"]
    if type_ == "enum":
        entry["options"] = _choices(hint)
    if type_ == "bool":
        if optional:
            raise TypeError(f"option {field.name}: a bool is true or false: write `bool`, without None")
        entry["mode"], entry["arg_false"] = "flag", f"--no-{flag}"
    return entry


def _plain(kind: inspect.Type, name: str) -> tuple[Any, dict[str, Any], bool]:
    """The type inside of Meta and ``| None``; title, description and extras of the Meta; whether None is allowed."""
    meta: dict[str, Any] = {}
    optional = False
    while True:
        if isinstance(kind, inspect.Metadata):
            meta = {**(kind.extra_json_schema or {}), **(kind.extra or {}), **meta}
            kind = kind.type
        elif isinstance(kind, inspect.UnionType):
            types = [one for one in kind.types if not isinstance(one, inspect.NoneType)]
            if len(types) != 1:
                raise TypeError(
                    f"option {name}: a form has no place for a choice of types: use one type, or `X | None`"
                )
            kind, optional = types[0], True
        else:
            return kind, meta, optional


def _choices(hint: Any) -> list[str]:
    """The strings of a Literal in the order of their declaration, which msgspec does not preserve."""
    if typing.get_origin(hint) is Literal:
        return list(typing.get_args(hint))
    return next((found for one in typing.get_args(hint) if (found := _choices(one))), [])


def _kind(kind: Any, name: str) -> str:
    found = _KINDS.get(type(kind))
    if found is None:
        what = type(kind).__name__.removesuffix("Type").lower()
        raise TypeError(f"option {name}: {what} cannot become a form: use bool, int, float, str or Literal of strings")
    if found == "enum" and not all(isinstance(value, str) for value in kind.values):
        raise TypeError(f"option {name}: a Literal must list strings only: write Literal['1', '2'] instead of numbers")
    for bound, instead in (("gt", "ge"), ("lt", "le")):
        if getattr(kind, bound, None) is not None:
            raise TypeError(f"option {name}: the bounds of a form belong to it: write {instead} instead of {bound}")
    return found


def _default(field: inspect.Field, type_: str) -> Any:
    """The default as JSON, so that the same script always has the same form."""
    if field.default_factory is not NODEFAULT:
        raise TypeError(f"option {field.name}: its default must be a plain value, not a function")
    if field.default is NODEFAULT or field.default is None:
        return None
    allowed = {"bool": bool, "int": int, "float": (int, float), "string": str, "enum": str}[type_]
    fits = isinstance(field.default, allowed) and (type_ == "bool" or not isinstance(field.default, bool))  # type: ignore[arg-type]
    if not fits or not math.isfinite(field.default if type_ == "float" else 0):
        raise TypeError(
            f"option {field.name}: its default {field.default!r} is not {_NOUNS.get(type_, 'true or false')}"
        )
    kind, _, _ = _plain(field.type, field.name)
    low, high = getattr(kind, "ge", None), getattr(kind, "le", None)
    if (low is not None and field.default < low) or (high is not None and field.default > high):
        raise TypeError(f"option {field.name}: its default {field.default!r} is outside of its own bounds")
    if type_ == "enum" and field.default not in kind.values:
        raise TypeError(f"option {field.name}: its default {field.default!r} is not one of its choices")
    return float(field.default) if type_ == "float" else field.default


# -- an entry becomes an option of the command line


def _add(parser: argparse.ArgumentParser, entry: Entry) -> None:
    if entry["type"] == "bool":
        flags = parser.add_mutually_exclusive_group()
        word = "on" if entry["default"] else "off"
        flags.add_argument(entry["arg"], dest=entry["key"], action="store_true", default=None,
                           help=f"{entry['label']} (default: {word})")  # fmt: skip
        flags.add_argument(entry["arg_false"], dest=entry["key"], action="store_false", default=None,
                           help=argparse.SUPPRESS if word == "off" else "the opposite")  # fmt: skip
        return
    parser.add_argument(
        entry["arg"],
        dest=entry["key"],
        metavar=entry["type"].upper(),
        type=_converter(entry),
        required=entry.get("required", False) and entry["default"] is None,
        help=_help(entry),
    )


def _help(entry: Entry) -> str:
    low, high, options = entry.get("min"), entry.get("max"), entry.get("options")
    notes = [f"one of {', '.join(options)}"] if options else []
    if low is not None and high is not None:
        notes.append(f"{low:g} to {high:g}")
    elif low is not None or high is not None:
        notes.append(f"at least {low:g}" if low is not None else f"at most {high:g}")
    notes.append("required" if entry.get("required") else f"default: {_shown(entry['default'])}")
    return f"{entry['label']} ({'; '.join(notes)})".replace("%", "%%")


def _shown(default: object) -> str:
    return "none" if default is None else str(default)


def _converter(entry: Entry) -> Callable[[str], object]:
    def convert(text: str) -> object:
        try:
            value = _value(entry["type"], text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {_NOUNS[entry['type']]}") from None
        if "options" in entry and value not in entry["options"]:
            raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(entry['options'])}")
        if "min" in entry and value < entry["min"]:
            raise argparse.ArgumentTypeError(f"{text} is below the minimum {entry['min']:g}")
        if "max" in entry and value > entry["max"]:
            raise argparse.ArgumentTypeError(f"{text} is above the maximum {entry['max']:g}")
        return value

    return convert


def _value(type_: str, text: str) -> Any:
    """Raises ValueError."""
    if type_ == "int":
        if not _whole(text):
            raise ValueError
        return int(text)
    if type_ == "float":
        number = float(text)
        if not math.isfinite(number):
            raise ValueError
        return number
    return text


def _joined(arguments: list[str], entries: list[Entry]) -> list[str]:
    """``--x -1e-05`` as ``--x=-1e-05``: argparse takes some numbers for options."""
    valued = {entry["arg"] for entry in entries if entry["type"] != "bool"}
    joined: list[str] = []
    words = iter(arguments)
    for word in words:
        value = next(words, None) if word in valued else None
        joined.append(word if value is None else f"{word}={value}")
    return joined
