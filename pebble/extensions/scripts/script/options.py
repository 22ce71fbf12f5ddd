"""A script's options as a msgspec Struct: operators' form is made from it, and a command line fills it."""

from __future__ import annotations

import os
import sys
import typing
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

import msgspec
from msgspec import NODEFAULT, inspect
from msgspec.structs import replace

from pebble.errors import PebbleError
from pebble.extensions.operator.client.forms import Setting, SettingError, Value, accepted
from pebble.extensions.operator.client.scripts import options_of, settings
from pebble.extensions.scripts.runs import CONFIG

Options = TypeVar("Options", bound=msgspec.Struct)

_KINDS: dict[type[inspect.Type], str] = {
    inspect.BoolType: "bool",
    inspect.IntType: "int",
    inspect.FloatType: "float",
    inspect.StrType: "string",
    inspect.LiteralType: "enum",
}
_RESERVED = ("config", "describe", "help")  # options that every script has
_OF_ALL = f"""\
    --config FILE                     The robot's config file (default: ${CONFIG})
    --describe                        Print the form that operators see, as JSON; only alone"""


def form(options: type[msgspec.Struct]) -> list[Setting]:
    """Return one setting per field. Raises TypeError that names the field and what to write instead."""
    hints = typing.get_type_hints(options)
    settings = [_setting(field, hints[field.name]) for field in inspect.type_info(options).fields]  # type: ignore[attr-defined]
    words = [word for setting in settings for word in (setting.arg, setting.arg_false) if word]
    for word in words:
        if words.count(word) > 1 or word.removeprefix("--") in _RESERVED:
            raise TypeError(f"option {word.removeprefix('--')}: {word} means something else already: rename the field")
    return settings


def parse(options: type[Options], words: list[str], program: str, about: str) -> tuple[Options, Path]:
    """Return the Struct that the words of a command line describe, and the path of the robot's config.

    ``--help`` prints ``about`` and the options, and ends the process; wrong words end it with exit code 2 and one line
    on stderr.
    """
    own = form(options)
    if not {"-h", "--help"}.isdisjoint(words):
        lines = [f"{program}: {about}", "", *(f"    {usage(setting)}" for setting in own), _OF_ALL]
        sys.stdout.write("\n".join(lines) + "\n")
        raise SystemExit(0)
    if "--describe" in words:  # not as the only word, which `run` has handled before
        _fail(program, "--describe goes alone: it prints the form and starts nothing")
    config, rest, remaining = os.environ.get(CONFIG), list[str](), iter(words)
    for word in remaining:
        option, equals_sign, value = word.partition("=")
        if option == "--config":
            config = value if equals_sign else next(remaining, None)
        else:
            rest.append(word)
    try:
        given = settings({"file": program, "configs": [setting.entry() for setting in own]}, rest)
        for setting in own:
            if setting.required and setting.default is None and setting.key not in given:
                _fail(program, f"{setting.arg} is missing")
        chosen = msgspec.convert(given, options)
    except (PebbleError, msgspec.ValidationError) as error:
        _fail(program, str(error))
    if config is None:
        _fail(program, "which robot? Add its config file, for example: --config goob.json")
    return chosen, Path(config)


def _fail(program: str, why: str) -> NoReturn:
    """End the process because of wrong words."""
    sys.stderr.write(f"{program}: {why} (see --help)\n")
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


# -- a setting in words


def usage(setting: Setting) -> str:
    """Return an option's line, such as ``--tag-id INT  Tag ID (default: 13)``."""
    names: dict[bool | None, str] = {}  # the first option for each value of a flag; None: for other settings
    for option, value in options_of(setting):
        names.setdefault(value, option)
    words = f"{names.get(None)} {setting.type.upper()}"
    if setting.type == "bool":
        words = f"[{names[True]} | {names[False]}]"
    notes = []
    if setting.options:
        notes.append(", ".join(map(str, setting.options)))
    if setting.min is not None:
        notes.append(f"min {setting.min}")
    if setting.max is not None:
        notes.append(f"max {setting.max}")
    notes.append("required" if setting.required else f"default: {setting.default}")
    return f"{words:32}  {setting.label or setting.key} ({'; '.join(notes)})"
