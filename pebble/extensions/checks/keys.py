"""Tables of all keys of a config, which ``pebble check --keys`` prints."""

from collections.abc import Iterator
from typing import get_args, get_origin

import msgspec
from msgspec import NODEFAULT
from msgspec.structs import FieldInfo, fields

from pebble.config.config import full_tree
from pebble.config.reader import expected, unwrap
from pebble.config.types import Section


def keys_text() -> str:
    """Return a table of the keys of each section, with their whole names, defaults and meanings."""
    return "".join(["# Keys of a config\n\n", *_chapters(full_tree(), "", {})]).rstrip("\n") + "\n"


def _chapters(kind: type[Section], path: str, places: dict[type[Section], str]) -> Iterator[str]:
    """Yield one table per section, depth first. A class that several sections share has one table, at the first."""
    places[kind] = path
    to_describe: list[tuple[type[Section], str]] = []
    rows = []
    for field in sorted(fields(kind), key=lambda field: not field.required):
        section, key = _section_of(field), f"{path}.{field.encode_name}".removeprefix(".")
        if section is None:
            rows.append(f"| `{key}` | {_default(field)} | {_meaning(field)}{_allowed(field)} |\n")
            continue
        place = key + _suffix_of(field)
        where_described = f"keys as in `{places[section]}`" if section in places else "keys below"
        rows.append(f"| `{key}` | | {_meaning(field)} ({where_described}) |\n")
        if section not in places:
            places[section] = place
            to_describe.append((section, place))
    yield f"## {f'`{path}`' if path else 'The whole file'}\n\n"
    yield f"{kind.__doc__}\n\n| key | default | meaning |\n|---|---|---|\n{''.join(rows)}\n"
    for text in dict.fromkeys(kind.all_retired().values()):
        keys = ", ".join(f"`{key}`" for key, replacement in kind.all_retired().items() if replacement == text)
        yield f"No longer used: {keys}; {text}.\n\n"
    for section, place in to_describe:
        yield from _chapters(section, place, places)


def _suffix_of(field: FieldInfo) -> str:
    """Return the text that follows a key with several sections: ``.<name>`` for a table, ``[]`` for a list, or ""."""
    return {dict: ".<name>", tuple: "[]"}.get(get_origin(unwrap(field.type)[0]), "")


def _section_of(field: FieldInfo) -> type[Section] | None:
    """Return the class of the section that a key holds, perhaps inside a table or list; None for other values."""
    kind, _ = unwrap(field.type)
    if get_origin(kind) is dict:
        _, kind = get_args(kind)  # of a table's values
    elif get_origin(kind) is tuple:
        kind = get_args(kind)[0]  # of a list's entries
    return kind if isinstance(kind, type) and issubclass(kind, Section) else None


def _meaning(field: FieldInfo) -> str:
    _, metas = unwrap(field.type)
    return next(meta.description for meta in metas if meta.description)


def _allowed(field: FieldInfo) -> str:
    """Return in words which values a key accepts; empty for a boolean or a text about which the metas add nothing."""
    kind, metas = unwrap(field.type)
    if get_origin(kind) is tuple:
        return " A list."
    if get_origin(kind) is dict:
        return " An object."
    # What the metas add, such as "choices" and "expected", but not "parse": the function that reads the values.
    added = [name for meta in metas for name in meta.extra or () if name != "parse"]
    if kind in (bool, str) and not added:
        return ""
    text = expected(kind, metas).partition(":")[0]  # of "a topic: 1 to 250 …" only "a topic"
    return f" {text[:1].upper()}{text[1:]}."


def _default(field: FieldInfo) -> str:
    if field.required:
        return "**required**"
    if field.default_factory is not NODEFAULT:
        return "`{}`"
    if field.default is None:
        return "not set"
    return f"`{msgspec.json.encode(field.default).decode()}`"
