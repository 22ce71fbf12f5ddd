"""The generator of the topic tables, payloads.schema.json and asyncapi.yaml."""

import inspect
import json
import re
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from msgspec import NODEFAULT, UNSET, UnsetType
from msgspec.structs import FieldInfo, fields

from pebble.contract import CHANNELS, INCOMING, OUTGOING, Channel, Kind
from pebble.contract.capabilities import CapabilitiesValue
from pebble.contract.payloads import Capabilities, Payload
from pebble.extensions.operator.contract import asyncapi
from pebble.extensions.operator.contract.schemas import schemas

TOPICS, SCHEMAS, ASYNCAPI = "topics.md", "payloads.schema.json", "asyncapi.yaml"

_JSON_TYPES = {Any: "any", NoneType: "null", bool: "boolean", int: "integer", float: "number", str: "string"}


def topics_document() -> str:
    """Return the tables of all topics, and of the fields of all payloads."""
    kinds = _table(("kind", "direction", "QoS", "retained", "meaning"), map(_kind_row, Kind))
    channels = (*_sections(INCOMING), *_sections(OUTGOING))
    return "\n".join(["# Topics\n", "## Kinds\n", kinds, *channels, "## Payloads\n", *map(_payload, _structs())])


def travels(channel: Channel) -> str:
    """Return the direction in which the bridge forwards a channel (paper Table A.1)."""
    if not channel.remote:
        return "stays on the robot"
    if not channel.bridged:
        return "directly between its process and the remote broker"
    if channel.direction == OUTGOING:
        return "robot to remote"
    if channel.kind in (Kind.FLAG, Kind.ACTION):
        return "both ways"
    return "remote to robot; back only with remote-mirror"


def authority(channel: Channel) -> str:
    """Return the side of the bridge whose values count when the two sides differ."""
    if channel.direction == OUTGOING:
        return "robot"
    if channel.kind is Kind.FLAG:
        return "last change; after an outage the robot's own change, else the remote retained value"
    return "operator, live only"


def _kind_row(kind: Kind) -> tuple[str, ...]:
    return (kind.name, kind.direction, str(kind.qos), _yes(kind.retain), kind.meaning)


def _sections(direction: str) -> tuple[str, ...]:
    """Return headings and tables of the channels of one direction."""
    channels = [channel for channel in CHANNELS if channel.direction == direction]
    return (
        f"## {direction.capitalize()}\n",
        _table(("topic", "kind", "payload", "QoS", "retained", "rate", "what it is"), map(_meaning_row, channels)),
        f"### {direction.capitalize()}: authority and forwarding\n",
        _table(("topic", "authoritative", "forwarded", "renamed at (config)"), map(_travel_row, channels)),
    )


def _meaning_row(channel: Channel) -> tuple[str, ...]:
    doc = channel.doc if channel.synonym_of is None else f"{channel.doc} Understood like `{channel.synonym_of}`."
    return (
        f"`{channel.suffix}`", channel.kind.name, _payload_name(channel), str(channel.default_qos),
        _yes(channel.default_retain), rate(channel), doc,
    )  # fmt: skip


def _travel_row(channel: Channel) -> tuple[str, ...]:
    return (
        f"`{channel.suffix}`",
        authority(channel),
        travels(channel),
        "" if channel.override is None else f"`{channel.override}`",
    )


def rate(channel: Channel) -> str:
    """Return a channel's nominal rate in words."""
    if channel.rate_hz:
        return f"{channel.rate_hz:g} Hz"
    return {Kind.STATE: "on change", Kind.STREAM: "varies", Kind.FEED: "varies"}.get(channel.kind, "on demand")


def payload_name(channel: Channel) -> str:
    """Return ``boolean``, ``binary``, or the name of the struct."""
    return {bool: "boolean", bytes: "binary"}.get(channel.payload) or str(channel.payload.__name__)


def _payload_name(channel: Channel) -> str:
    name = payload_name(channel)
    return name if channel.payload in (bool, bytes) else f"[{name}](#{name.lower()})"


def _structs() -> list[type[Payload]]:
    """Return the payload structs in the order of their channels, each followed by the structs inside it."""
    structs: dict[type[Payload], None] = {}
    for channel in CHANNELS:
        _collect(channel.payload, structs)
    return list(structs)


def _collect(kind: Any, structs: dict[type[Payload], None]) -> None:
    """Add a struct, or those inside a type such as ``list[Struct]``, and the structs of its fields."""
    if isinstance(kind, type) and issubclass(kind, Payload) and kind not in structs:
        structs[kind] = None
        for member in get_type_hints(kind).values():
            _collect(member, structs)
        if kind is Capabilities:  # its value is declared as any object
            _collect(CapabilitiesValue, structs)
    for inner in get_args(kind):
        _collect(inner, structs)


def _payload(struct: type[Payload]) -> str:
    remarks = _remarks(struct)
    kinds = get_type_hints(struct)
    rows = [
        (f"`{member.encode_name}`", _type_name(kinds[member.name]), _default(member), remarks.get(member.name, ""))
        for member in fields(struct)
    ]
    doc = inspect.cleandoc(struct.__doc__).replace("``", "`") + "\n\n" if struct.__doc__ else ""
    return f"### {struct.__name__}\n\n{doc}" + _table(("field", "type", "default", "remark"), rows)


def _type_name(kind: Any) -> str:
    """Return a field's type in JSON's terms; an optional field's default shows that it may be absent."""
    origin, inner = get_origin(kind), [argument for argument in get_args(kind) if argument is not UnsetType]
    if origin in (Union, UnionType):
        return " or ".join(map(_type_name, inner))
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value)}`" for value in inner)
    if origin is list:
        return f"array of {_type_name(inner[0])}"
    if origin is tuple:
        return f"[{', '.join(map(_type_name, inner))}]"
    if origin is dict:
        return f"object of {_type_name(inner[1])}" if inner[1] is not Any else "object"
    return _JSON_TYPES.get(kind) or f"[{kind.__name__}](#{kind.__name__.lower()})"


def _default(member: FieldInfo) -> str:
    if member.required:
        return "required"
    value = member.default if member.default_factory is NODEFAULT else member.default_factory()
    return "absent" if value is UNSET else f"`{json.dumps(value)}`"


@cache  # inspect parses the whole module for each class
def _source(struct: type[Payload]) -> str:
    return inspect.getsource(struct)


def _remarks(struct: type[Payload]) -> dict[str, str]:
    """Return the comments after the fields of a struct: units and meanings."""
    sources = [_source(base) for base in reversed(struct.__mro__) if issubclass(base, Payload)]
    lines = [line for source in sources for line in source.splitlines()]
    matches = (re.match(r"    (\w+): [^#]*#\s*(.+)$", line) for line in lines)
    return {match[1]: match[2] for match in matches if match is not None}


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def documents() -> dict[str, str]:
    """Return the generated files by name."""
    return {
        TOPICS: topics_document(),
        SCHEMAS: json.dumps(schemas(), indent=2) + "\n",
        ASYNCAPI: asyncapi.document(),
    }


def main(arguments: list[str]) -> None:
    """Write the files into the given folder."""
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in documents().items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
