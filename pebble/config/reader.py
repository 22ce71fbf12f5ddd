"""Reads config sections from plain data. It continues after a mistake, so that all are reported at once."""

import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import NODEFAULT, Meta
from msgspec.structs import FieldInfo, fields

from pebble.config import problems
from pebble.config.other_forms import reading_of, switch
from pebble.config.types import Secret, Section
from pebble.errors import PebbleError

S = TypeVar("S", bound=Section)
#: Checks a finished section of its class; returns it, completed if necessary.
Check = Callable[["Reader", Any, problems.Path], Any]
#: The class of the sections that a check is for, subclasses included.
Rule = tuple[type[Section], Check]

_NUMBER = re.compile(r"[+-]?[0-9.]{1,10}|true|false", re.ASCII).fullmatch
_SAME_SECTION = 0.7  # of 1.0: a name this similar to a known one is a mistake, not another program's section
_WRONG = object()  # in place of a refused value: the key gets its default


@cache  # fields() looks up each name of a type, which takes longer than all else that a reader does
def _known(kind: type[Section]) -> dict[str, FieldInfo]:
    return {field.encode_name: field for field in fields(kind)}


class Reader:
    """A reader of one file. Relative paths start at ``folder``; ``env`` is the environment for secrets.

    ``file``: the config file; root reads the files that it names only if the owner of the config may read them. With
    ``other_forms`` it also accepts what the original accepts; where that changes a value, it notes a warning.
    """

    def __init__(
        self,
        folder: Path,
        env: Mapping[str, str],
        rules: Sequence[Rule],
        notes: problems.Notes | None = None,
        *,
        file: Path | None = None,
        other_forms: bool = False,
    ) -> None:
        self.file = file or folder  # only its owner matters, see `read_for`
        self.folder, self.env, self.notes, self._other_forms = folder, env, notes or problems.Notes(), other_forms
        self.password_variables: dict[str, None] = {}  # the names that were read, in order
        self._rules = rules

    def section(self, kind: type[S], raw: Any, path: problems.Path = ()) -> S:
        """Return a section of ``kind``. A refused value becomes the default, a missing required one None."""
        keys = _known(kind)
        if not isinstance(raw, dict):
            if self._other_forms and "enabled" in keys and switch(raw) is not None:
                raw = {"enabled": raw}  # a mere true or false in place of the section
            else:
                raw = self._replacement(kind, raw, path, {} if path else NODEFAULT)  # the whole file has no default
        values: dict[str, Any] = {}
        pairs = () if raw is _WRONG else raw.items()  # a refused section has all its defaults
        for written, value in pairs:
            key = self._key(kind, keys, written, (*path, written))
            field = keys.get(key)
            if field is None or value in ("", None):  # unknown, which `_key` has noted; or not set ("" or null)
                continue
            if self._other_forms and value == [] and isinstance(field.default, tuple):  # for the original: unset
                continue
            default = field.default if field.default_factory is NODEFAULT else field.default_factory()
            result = self._value(field.type, value, (*path, written), default)
            if result is not _WRONG:
                values[field.name] = result
        for field in keys.values():
            if field.required and field.name not in values:
                values[field.name] = self._missing(field, (*path, field.encode_name))
        section = kind(**values)
        for checked_kind, check in self._rules:
            if isinstance(section, checked_kind):
                section = check(self, section, path)
        return section

    def _key(self, kind: type[Section], known: Mapping[str, Any], key: str, path: problems.Path) -> str:
        """Return a key's present name. Note an unknown key: a warning if another program may use it, else a problem."""
        name = kind.other_names.get(key, key)
        for retired, replacement in kind.all_retired().items():
            if key == retired or (retired.endswith("*") and key.startswith(retired[:-1])):
                self.notes.retired.append(problems.Note(path, replacement))
                return key  # it has no present name: nothing reads it
        if key in kind.refused:
            self.notes.problem(path[:-1], f"{key} {kind.refused[key]}")  # of its section: the text has the key
        elif name not in known and kind.holds_others and not problems.near(key, known, _SAME_SECTION):
            self.notes.warning(path, "is not read: nothing that is installed has a section of this name")
        elif name not in known:
            self.notes.problem(path, f"unknown key, {problems.nearest(key, known)}")
        return name

    def _missing(self, field: FieldInfo, path: problems.Path) -> Any:
        kind, metas = unwrap(field.type)
        if _is_section(kind):
            return self.section(kind, {}, path)
        self.notes.doubt(path, f"is missing, write {expected(kind, metas)}")
        return None

    def _value(self, annotation: Any, raw: Any, path: problems.Path, default: Any = NODEFAULT) -> Any:
        """Return the value of a key, or _WRONG. What the key does not accept goes to _replacement."""
        kind, metas = unwrap(annotation)
        container = get_origin(kind)
        if _is_section(kind):
            return self.section(kind, raw, path)
        if container is tuple:
            item = get_args(kind)[0]
            is_line = isinstance(raw, str) and unwrap(item)[0] is str
            listed = self._words(raw, path) if is_line else raw
            if isinstance(listed, list):
                return self._list(item, listed, path)
        elif container is dict:
            if isinstance(raw, dict):
                name, item = get_args(kind)
                return self._map(name, item, raw, path)
        elif kind is Path:
            if isinstance(raw, str):
                return self._path(raw, metas, path)
        else:
            return self._scalar(annotation, raw, path, default)
        return self._replacement(annotation, raw, path, default)

    def _scalar(self, annotation: Any, raw: Any, path: problems.Path, default: Any) -> Any:  # text, number or bool
        kind, metas = unwrap(annotation)
        choices = _choices(kind, metas)
        if choices and isinstance(raw, str):  # upper and lower case count as one
            raw = next((choice for choice in choices if str(choice).lower() == raw.lower()), raw)
        try:
            value = msgspec.convert(raw, annotation)
        except msgspec.ValidationError:
            return self._replacement(annotation, raw, path, default)
        if choices and value not in choices:
            return self._replacement(annotation, raw, path, default)
        return Secret(value) if _extra(metas, "secret") else self._parsed(metas, value, path)

    def _replacement(self, annotation: Any, raw: Any, path: problems.Path, default: Any) -> Any:
        """Return the value to use for a refused ``raw``, or _WRONG. Note it unless the value differs only in form."""
        kind, metas = unwrap(annotation)
        shown = "a value of another kind" if _extra(metas, "secret") else _shown(raw)
        tells_nothing = shown == "text" and (get_origin(kind) is Literal or kind in (str, Path))
        must_be = f"must be {expected(kind, metas)}" + ("" if tells_nothing else f", not {shown}")
        reading = reading_of(annotation, kind, metas, raw, default) if self._other_forms else None
        if reading is not None and reading.differs:  # another value takes its place, with a warning
            is_set = bool(reading.value) or reading.value == 0  # 0 and false are values
            used = f"{msgspec.json.encode(reading.value).decode()} is used" if is_set else "it counts as not set"
            self.notes.warning(path, f"{must_be}; {used}")
            return reading.value
        is_raw = reading is not None and type(reading.value) is type(raw) and reading.value == raw
        if reading is None or is_raw:  # there is no other form of ``raw``, which would be refused again
            self.notes.problem(path, must_be)
            return _WRONG
        return self._scalar(annotation, reading.value, path, NODEFAULT)  # another form of a valid value

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

    def _list(self, item: Any, raw: list[Any], path: problems.Path) -> Any:
        items = [self._value(item, value, (*path, index)) for index, value in enumerate(raw)]
        return tuple(value for value in items if value is not _WRONG)

    def _words(self, line: str, path: problems.Path) -> list[str]:
        import shlex  # few files write a list as one line

        try:
            words = shlex.split(line)
        except ValueError as error:
            self.notes.problem(path, f"cannot be split into words: {error}; write a list of words")
            return []
        if not words:
            self.notes.problem(path, "holds no word: write a list of words, or leave the key out")
        return words

    def _map(self, name: Any, item: Any, raw: dict[str, Any], path: problems.Path) -> Any:
        items = {key: self._value(item, value, (*path, key)) for key, value in raw.items()}
        named = {key: self._value(name, key, path) for key in raw}
        return {key: value for key, value in items.items() if _WRONG not in (value, named[key])}


def unwrap(annotation: Any) -> tuple[Any, list[Meta]]:
    """Return the bare type behind ``Annotated`` and ``| None``, and the annotations around it."""
    metas: list[Meta] = []
    while True:
        if get_origin(annotation) is Annotated:
            annotation, *outer = get_args(annotation)
            metas += outer
        elif get_origin(annotation) in (Union, types.UnionType) and types.NoneType in get_args(annotation):
            others = tuple(kind for kind in get_args(annotation) if kind is not types.NoneType)
            annotation = Union[others]  # noqa: UP007 - of a tuple made at run time
        else:
            return annotation, metas


def expected(kind: Any, metas: list[Meta]) -> str:
    """Return a correct value in words, to follow "must be", such as ``an integer from 1 to 10``."""
    if text := _extra(metas, "expected"):
        return str(text)
    if choices := _choices(kind, metas):
        *most, last = (msgspec.json.encode(choice).decode() for choice in choices)
        return f"{', '.join(most)} or {last}" if most else last
    if get_origin(kind) is tuple:
        return "a list […]"
    if get_origin(kind) is dict or _is_section(kind):
        return "an object {…}"
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(expected(member, []) for member in get_args(kind))
    name = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}[kind]
    return " ".join((name, *_limits(metas)))


def _limits(metas: list[Meta]) -> Iterator[str]:
    """Yield a number's limits in words, to follow "a number"."""
    limits = [(name, getattr(meta, name)) for meta in metas for name in ("ge", "gt", "le")]
    bound = {name: limit for name, limit in limits if limit is not None}  # of several ``metas`` the last counts
    if "ge" in bound and "le" in bound:
        yield f"from {bound['ge']} to {bound['le']}"
    elif "gt" in bound:
        yield f"above {bound['gt']}"
        if "le" in bound:
            yield f"and at most {bound['le']}"
    elif "ge" in bound:
        yield f"of at least {bound['ge']}"


def _choices(kind: Any, metas: list[Meta]) -> tuple[Any, ...]:
    """Return the values that a key may have, if they are listed; extensions may add to ``choices``."""
    return get_args(kind) if get_origin(kind) is Literal else tuple(_extra(metas, "choices") or ())


def _extra(metas: list[Meta], name: str) -> Any:
    return next((meta.extra[name] for meta in metas if meta.extra and name in meta.extra), None)


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Section)


def _shown(raw: Any) -> str:
    """Return a value for an error message. A text is shown only if it is a number: it may be a misplaced secret."""
    if isinstance(raw, str):
        return f'the text "{raw}"' if _NUMBER(raw) else "text"  # 1883 and "1883" look alike
    if isinstance(raw, dict):
        return "an object"
    if isinstance(raw, list):
        return "a list"
    text = msgspec.json.encode(raw).decode()
    return text if len(text) <= 60 else f"{text[:57]}…"
