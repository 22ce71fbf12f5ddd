"""Writes messages.d.ts, the types of messages between pages and server, and the table of the sentences for people.

Program: ``python tools/messages_docs.py`` writes messages.d.ts; a test checks that it is current. With a folder it
writes the table there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from msgspec import inspect as types

from pebble.contract.capabilities import RobotIdentity
from pebble.extensions.operator.client import drive_reasons
from pebble.extensions.page import messages

DECLARATIONS = Path(messages.__file__).parent / "static" / "messages.d.ts"


def words() -> str:
    """Return the table of sentences for the states in which a robot is not driven."""
    rows = [f"| `{code}` | {text} |" for code, text in drive_reasons.WORDS.items()]
    return "\n".join(["# Words for people\n", "| state | sentence |", "|---|---|", *rows, ""])


def declarations() -> str:
    """Return messages.d.ts: one interface for each struct, and for what a robot reports of itself."""
    parts = ["// Generated from pebble/extensions/page/messages.py by python tools/messages_docs.py.\n"]
    for struct in (
        *get_args(messages.FromPage),
        *get_args(messages.ToPage),
        *get_args(messages.FromReplay),
        messages.Played,
        messages.ShownOwner,
        messages.TalkAnswer,
        RobotIdentity,
        *_views(),
    ):
        info: Any = types.type_info(struct)
        tag = [f'  op: "{info.tag}";'] if info.tag is not None else []
        fields = [f"  {member.name}{'' if member.required else '?'}: {_script(member.type)};" for member in info.fields]
        parts.append("\n".join([f"export interface {struct.__name__} {{", *tag, *fields, "}\n"]))
    metrics = [f'  "{name}": {view.__name__};' for name, view in messages.SERVER_METRICS.items()]
    parts.append("\n".join(["export interface Metrics {", *metrics, "}\n"]))
    for name in ("FromPage", "ToPage"):
        members = " | ".join(struct.__name__ for struct in get_args(getattr(messages, name)))
        parts.append(f"export type {name} = {members};\n")
    return "\n".join(parts)


def _views() -> Iterator[type]:
    """Yield the types of the server's metrics, each after those that it contains."""
    yield messages.OwnerState
    yield from messages.SERVER_METRICS.values()


def _script(kind: Any) -> str:
    """Return a type of msgspec's as TypeScript writes it."""
    match kind:
        case types.Metadata():
            return _script(kind.type)
        case types.StrType():
            return "string"
        case types.IntType() | types.FloatType():
            return "number"
        case types.BoolType():
            return "boolean"
        case types.NoneType():
            return "null"
        case types.UnionType():
            return " | ".join(map(_script, kind.types))
        case types.StructType():
            return str(kind.cls.__name__)
        case types.LiteralType():
            return " | ".join(json.dumps(value) for value in kind.values)
        case types.DictType():
            return f"Record<{_script(kind.key_type)}, {_script(kind.value_type)}>"
        case types.VarTupleType():
            item = _script(kind.item_type)
            return f"({item})[]" if "|" in item else f"{item}[]"
        case types.TupleType():
            return f"[{', '.join(map(_script, kind.item_types))}]"
    return "any"


def main(arguments: list[str]) -> None:
    """Write the table into the given folder; without one, messages.d.ts of this checkout."""
    if not arguments:
        DECLARATIONS.write_text(declarations(), encoding="utf-8")
        return
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "words.md").write_text(words(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
