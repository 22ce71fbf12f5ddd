"""Turns plain data into config sections; continues after a mistake, so that all are reported at once."""

import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Meta
from msgspec.structs import FieldInfo, fields

from pebble.config import problems
from pebble.config.types import Secret, Section
from pebble.errors import PebbleError

S = TypeVar("S", bound=Section)
#: Checks a finished section of its class; returns it, completed if necessary.
Check = Callable[["Reader", Any, problems.Path], Any]
#: The class of the sections that a check is for, subclasses included.
Rule = tuple[type[Section], Check]

_NUMBER = re.compile(r"[+-]?[0-9.]{1,10}|true|false", re.ASCII).fullmatch
_WRONG = object()  # in place of a refused value: the key gets its default


@cache  # each name of a type is looked up anew, which takes longer than all else that a reader does
def _known(kind: type[Section]) -> dict[str, FieldInfo]:
    return {field.encode_name: field for field in fields(kind)}


class Reader:
    """Reads one file. Relative paths start at ``folder``; ``env`` is the environment for secrets."""

    def __init__(
        self, folder: Path, env: Mapping[str, str], rules: Sequence[Rule], notes: problems.Notes | None = None
    ) -> None:
        self.folder, self.env, self.notes = folder, env, notes or problems.Notes()
        self.password_variables: dict[str, None] = {}  # those that were read, in order
        self._rules = rules

    def section(self, kind: type[S], raw: Any, path: problems.Path = ()) -> S:
        """A section of ``kind``. Refused values are noted and replaced by their defaults (missing ones by None)."""
        if not isinstance(raw, dict):
            self.notes.problem(path, f"must be an object {{…}}, not {_shown(raw)}")
            raw = {}
        known = _known(kind)
        values: dict[str, Any] = {}
        for key, value in raw.items():
            self._note_key(kind, known, key, (*path, key))
            if key in known and value not in ("", None):
                read = self._value(known[key].type, value, (*path, key))
                if read is not _WRONG:
                    values[known[key].name] = read
        for field in known.values():
            if field.required and field.name not in values:
                values[field.name] = self._missing(field, (*path, field.encode_name))
        return self._checked(kind(**values), path)

    def _checked(self, section: S, path: problems.Path) -> S:
        for kind, check in self._rules:
            if isinstance(section, kind):
                section = check(self, section, path)
        return section

    def _note_key(self, kind: type[Section], known: Mapping[str, Any], key: str, path: problems.Path) -> None:
        for name, replacement in kind.all_retired().items():
            if key == name or (name.endswith("*") and key.startswith(name[:-1])):
                self.notes.retired.append(problems.Note(path, replacement))
                return
        if key in kind.refused:
            self.notes.problem(path[:-1], f"{key} {kind.refused[key]}")
        elif key not in known:
            self.notes.problem(path, f"unknown key, {problems.nearest(key, known)}")

    def _missing(self, field: FieldInfo, path: problems.Path) -> Any:
        kind, metas = unwrap(field.type)
        if _is_section(kind):
            return self.section(kind, {}, path)
        self.notes.doubt(path, f"is missing, write {expected(kind, metas)}")
        return None

    def _value(self, annotation: Any, raw: Any, path: problems.Path) -> Any:
        kind, metas = unwrap(annotation)
        if _is_section(kind):
            return self.section(kind, raw, path)
        if get_origin(kind) is tuple:
            return self._list(get_args(kind)[0], raw, path)
        if get_origin(kind) is dict:
            name, item = get_args(kind)
            return self._map(name, item, raw, path)
        if kind is Path:
            return self._path(raw, metas, path) if isinstance(raw, str) else self._refuse(kind, metas, raw, path)
        choices = _choices(kind, metas)
        if choices and isinstance(raw, str):
            raw = next((choice for choice in choices if str(choice).lower() == raw.lower()), raw)
        try:
            value = msgspec.convert(raw, annotation)
        except msgspec.ValidationError:
            return self._refuse(kind, metas, raw, path)
        if choices and value not in choices:
            return self._refuse(kind, metas, raw, path)
        return Secret(value) if _extra(metas, "secret") else self._parsed(metas, value, path)

    def _parsed(self, metas: list[Meta], value: Any, path: problems.Path) -> Any:
        parse = _extra(metas, "parse")
        try:
            return value if parse is None else parse(value)
        except PebbleError as error:
            self.notes.problem(path, str(error))
            return _WRONG

    def _path(self, text: str, metas: list[Meta], path: problems.Path) -> Any:
        if self._parsed(metas, text, path) is _WRONG:
            return _WRONG
        try:
            return self.folder / Path(text).expanduser()
        except RuntimeError:  # ~name of an unknown user, or ~ without a home
            self.notes.problem(path, "names a home folder that is not known, write the whole path")
            return _WRONG

    def _list(self, item: Any, raw: Any, path: problems.Path) -> Any:
        if isinstance(raw, str) and unwrap(item)[0] is str:
            raw = self._words(raw, path)
        if not isinstance(raw, list):
            self.notes.problem(path, f"must be a list […], not {_shown(raw)}")
            return _WRONG
        items = [self._value(item, value, (*path, index)) for index, value in enumerate(raw)]
        return tuple(value for value in items if value is not _WRONG)

    def _words(self, line: str, path: problems.Path) -> list[str]:
        import shlex  # few files write a list as one line

        try:
            return shlex.split(line)
        except ValueError as error:
            self.notes.problem(path, f"cannot be split into words: {error}; write a list of words")
            return []

    def _map(self, name: Any, item: Any, raw: Any, path: problems.Path) -> Any:
        if not isinstance(raw, dict):
            self.notes.problem(path, f"must be an object {{…}}, not {_shown(raw)}")
            return _WRONG
        items = {key: self._value(item, value, (*path, key)) for key, value in raw.items()}
        named = {key: self._value(name, key, path) for key in raw}
        return {key: value for key, value in items.items() if _WRONG not in (value, named[key])}

    def _refuse(self, kind: Any, metas: list[Meta], raw: Any, path: problems.Path) -> Any:
        shown = "a value of another kind" if _extra(metas, "secret") else _shown(raw)
        instead = "" if shown == "text" and (get_origin(kind) is Literal or kind in (str, Path)) else f", not {shown}"
        self.notes.problem(path, f"must be {expected(kind, metas)}{instead}")
        return _WRONG


def unwrap(annotation: Any) -> tuple[Any, list[Meta]]:
    """The bare type behind ``Annotated`` and ``| None``, and the annotations around it."""
    metas: list[Meta] = []
    while True:
        if get_origin(annotation) is Annotated:
            annotation, *more = get_args(annotation)
            metas += more
        elif get_origin(annotation) in (Union, types.UnionType) and types.NoneType in get_args(annotation):
            others = tuple(kind for kind in get_args(annotation) if kind is not types.NoneType)
            annotation = Union[others]  # noqa: UP007 - of a tuple made at run time
        else:
            return annotation, metas


def expected(kind: Any, metas: list[Meta]) -> str:
    """A correct value in words, to follow "must be"."""
    if text := _extra(metas, "expected"):
        return str(text)
    if choices := _choices(kind, metas):
        *most, last = (msgspec.json.encode(choice).decode() for choice in choices)
        return f"{', '.join(most)} or {last}" if most else last
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(expected(member, []) for member in get_args(kind))
    name = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}[kind]
    return " ".join((name, *_limits(metas)))


def _limits(metas: list[Meta]) -> Iterator[str]:
    bound: dict[str, float] = {}
    for meta in metas:
        bound |= {name: limit for name in ("ge", "gt", "le") if (limit := getattr(meta, name)) is not None}
    if "ge" in bound and "le" in bound:
        yield f"from {bound['ge']} to {bound['le']}"
    elif "gt" in bound:
        yield f"above {bound['gt']}"
        if "le" in bound:
            yield f"and at most {bound['le']}"
    elif "ge" in bound:
        yield f"of at least {bound['ge']}"


def _choices(kind: Any, metas: list[Meta]) -> tuple[Any, ...]:
    """The values that a key may have, where they are listed; an extension may add to those of ``choices``."""
    return get_args(kind) if get_origin(kind) is Literal else tuple(_extra(metas, "choices") or ())


def _extra(metas: list[Meta], name: str) -> Any:
    return next((meta.extra[name] for meta in metas if meta.extra and name in meta.extra), None)


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Section)


def _shown(raw: Any) -> str:
    """What was written, in words; of a text only a number, because a secret may have been written in a wrong place."""
    if isinstance(raw, str):
        return f'the text "{raw}"' if _NUMBER(raw) else "text"  # 1883 and "1883" look alike
    if isinstance(raw, dict):
        return "an object"
    if isinstance(raw, list):
        return "a list"
    text = msgspec.json.encode(raw).decode()
    return text if len(text) <= 60 else f"{text[:57]}…"
