"""A script's options as a msgspec Struct: operators' form is made from it, and a command line fills it."""

from __future__ import annotations

import argparse
import sys
import typing
from collections.abc import Callable
from typing import Any, Literal, NoReturn, TypeVar

import msgspec
from msgspec import NODEFAULT, inspect
from msgspec.structs import replace

from pebble.extensions.operator.client.forms import Setting, SettingError, Value, accepted

Options = TypeVar("Options", bound=msgspec.Struct)

_KINDS: dict[type[inspect.Type], str] = {
    inspect.BoolType: "bool",
    inspect.IntType: "int",
    inspect.FloatType: "float",
    inspect.StrType: "string",
    inspect.LiteralType: "enum",
}
_RESERVED = ("config", "describe", "help")  # options that every script has


def form(options: type[msgspec.Struct]) -> list[Setting]:
    """Return one setting per field. Raises TypeError that names the field and what to write instead."""
    hints = typing.get_type_hints(options)
    settings = [_setting(field, hints[field.name]) for field in inspect.type_info(options).fields]  # type: ignore[attr-defined]
    words = [word for setting in settings for word in (setting.arg, setting.arg_false) if word]
    for word in words:
        if words.count(word) > 1 or word.removeprefix("--") in _RESERVED:
            raise TypeError(f"option {word.removeprefix('--')}: {word} means something else already: rename the field")
    return settings


def parse(
    options: type[Options], arguments: list[str], parser: argparse.ArgumentParser
) -> tuple[Options, argparse.Namespace]:
    """Return the Struct that the words of a command line describe, and the values of all options of ``parser``.

    Wrong words end the process with exit code 2 and one line on stderr.
    """
    settings = form(options)
    for setting in settings:
        _add(parser, setting)
    namespace = parser.parse_args(_joined(arguments, settings))
    values = {setting.key: getattr(namespace, setting.key) for setting in settings}
    try:
        return msgspec.convert({key: value for key, value in values.items() if value is not None}, options), namespace
    except msgspec.ValidationError as error:
        parser.error(str(error))


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and which accepts no abbreviated options."""

    def __init__(self, *, prog: str, description: str = "") -> None:
        super().__init__(prog=prog, description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        sys.stderr.write(f"{self.prog}: {message} (see --help)\n")
        raise SystemExit(2)


# -- a field becomes a setting


def _setting(field: inspect.Field, hint: Any) -> Setting:
    """Return the setting that a field declares; ``hint``: its type as written. Raises TypeError."""
    kind, meta, is_optional = _plain(field.type, field.name)
    name, type_ = field.encode_name, _kind(kind, field.name)
    option = meta.get("arg", name.replace("_", "-"))
    is_flag = type_ == "bool"
    if is_flag and is_optional:
        raise TypeError(f"option {field.name}: a bool is true or false: write `bool`, without None")
    setting = Setting(
        key=name,
        label=meta.get("title", name.replace("_", " ").capitalize()),
        type=type_,
        arg=f"--{option}",
        required=field.required or bool(meta.get("required")),
        min=getattr(kind, "ge", None),
        max=getattr(kind, "le", None),
        step=meta.get("step"),
        options=_choices(hint) if type_ == "enum" else (),
        mode="flag" if is_flag else None,
        arg_false=f"--no-{option}" if is_flag else None,
    )
    return replace(setting, default=_default(field, setting))


def _plain(kind: inspect.Type, name: str) -> tuple[Any, dict[str, Any], bool]:
    """Return the type inside of Meta and ``| None``, the Meta's other facts, and whether None is allowed."""
    meta: dict[str, Any] = {}
    optional = False
    while True:
        if isinstance(kind, inspect.Metadata):
            meta = {**(kind.extra_json_schema or {}), **(kind.extra or {}), **meta}
            kind = kind.type
        elif isinstance(kind, inspect.UnionType):
            types = [member for member in kind.types if not isinstance(member, inspect.NoneType)]
            if len(types) != 1:
                raise TypeError(
                    f"option {name}: a form has no place for a choice of types: use one type, or `X | None`"
                )
            kind, optional = types[0], True
        else:
            return kind, meta, optional


def _choices(hint: Any) -> list[str]:
    """Return the strings of a Literal in the order of their declaration, which msgspec does not preserve."""
    if typing.get_origin(hint) is Literal:
        return list(typing.get_args(hint))
    inner = map(_choices, typing.get_args(hint))  # inside Annotated, or a union with None
    return next(filter(None, inner), [])


def _kind(kind: Any, name: str) -> Any:
    """Return the type of setting for a field's type. Raises TypeError that says what to write instead."""
    form = _KINDS.get(type(kind))
    if form is None:
        what = type(kind).__name__.removesuffix("Type").lower()
        raise TypeError(f"option {name}: {what} cannot become a form: use bool, int, float, str or Literal of strings")
    if form == "enum" and not all(isinstance(value, str) for value in kind.values):
        raise TypeError(f"option {name}: a Literal must list strings only: write Literal['1', '2'] instead of numbers")
    for bound, instead in (("gt", "ge"), ("lt", "le")):
        if getattr(kind, bound, None) is not None:
            raise TypeError(f"option {name}: the bounds of a form belong to it: write {instead} instead of {bound}")
    return form


def _default(field: inspect.Field, setting: Setting) -> Value:
    """Return the default as JSON. A default_factory is refused: the form would change from start to start."""
    if field.default_factory is not NODEFAULT:
        raise TypeError(f"option {field.name}: its default must be a plain value, not a function")
    if field.default is NODEFAULT or field.default is None:
        return None
    try:
        return accepted(setting, field.default)
    except SettingError as error:
        raise TypeError(f"option {field.name}: its default {field.default!r} is refused: {error}") from None


# -- a setting becomes an option of the command line


def _add(parser: argparse.ArgumentParser, setting: Setting) -> None:
    """Add the setting to the options of the command line."""
    if setting.type == "bool":
        help_ = f"{setting.label} (default: {'on' if setting.default else 'off'})"
        action = argparse.BooleanOptionalAction
        # default=None: if the option is not given, `parse` leaves the default to the Struct.
        parser.add_argument(str(setting.arg), dest=setting.key, action=action, default=None, help=help_)
        return
    parser.add_argument(
        str(setting.arg),
        dest=setting.key,
        metavar=setting.type.upper(),
        type=str if setting.type == "string" else _converter(setting),
        required=setting.required and setting.default is None,
        help=_help(setting),
    )


def _help(setting: Setting) -> str:
    notes = [f"one of {', '.join(map(str, setting.options))}"] if setting.options else []
    if setting.min is not None and setting.max is not None:
        notes.append(f"{setting.min:g} to {setting.max:g}")
    elif setting.min is not None:
        notes.append(f"at least {setting.min:g}")
    elif setting.max is not None:
        notes.append(f"at most {setting.max:g}")
    default = "none" if setting.default is None else str(setting.default)
    notes.append("required" if setting.required else f"default: {default}")
    return f"{setting.label} ({'; '.join(notes)})".replace("%", "%%")


def _converter(setting: Setting) -> Callable[[str], object]:
    def convert(text: str) -> object:
        try:
            return accepted(setting, text)
        except SettingError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return convert


def _joined(arguments: list[str], settings: list[Setting]) -> list[str]:
    """Return words with ``--x=-1e-05`` for ``--x -1e-05``, which argparse would take for an option."""
    valued = {setting.arg for setting in settings if setting.type != "bool"}
    joined: list[str] = []
    words = iter(arguments)
    for word in words:
        value = next(words, None) if word in valued else None  # the next word, which the loop leaves out then
        joined.append(word if value is None else f"{word}={value}")
    return joined
