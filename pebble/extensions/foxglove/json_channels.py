"""The JSON channels of robots for Foxglove, with JSON Schemas in the subset that its parser reads."""

from functools import cache
from typing import Any, Final

import msgspec

from pebble.contract import Channel
from pebble.contract.payloads import AnyObject
from pebble.extensions.foxglove.server import ChannelSpec
from pebble.extensions.operator.contract.schemas import schemas

_PLAIN: Final = frozenset({"boolean", "string", "number", "integer"})
_ANY: Final = "pebble.Any"
_DEEPEST: Final = 8


def json_spec(topic: str, channel: Channel | None) -> ChannelSpec:
    """Return the Foxglove channel of this topic.

    Foxglove plots only fields that a schema names. If the schema cannot name every field it is left out, so that the
    channel may hold any JSON.
    """
    name, schema = (_ANY, b"") if channel is None else _schema_of(channel.suffix, channel.payload)
    return ChannelSpec(topic, "json", name, "jsonschema", schema)


@cache
def _schema_of(suffix: str, payload: type) -> tuple[str, bytes]:
    document, name = schemas(), f"pebble.{payload.__name__}"
    reduced = _reduced(document["topics"][suffix], document["$defs"], 0)
    if payload is AnyObject or reduced is None or reduced["type"] != "object":
        return _ANY, b""
    return name, msgspec.json.encode({"title": name, **reduced})


def _reduced(schema: dict[str, Any], definitions: dict[str, Any], depth: int) -> dict[str, Any] | None:
    """Return a schema in the subset that Foxglove reads: plain types, objects with known fields, arrays of these.

    None if it cannot be expressed so.
    """
    if depth > _DEEPEST:
        return None
    if "$ref" in schema:
        return _reduced(definitions[schema["$ref"].rpartition("/")[2]], definitions, depth + 1)
    if "anyOf" in schema:
        kinds = [kind for kind in schema["anyOf"] if kind.get("type") != "null"]
        return _reduced(kinds[0], definitions, depth + 1) if len(kinds) == 1 else None
    kind = schema.get("type")
    if kind in _PLAIN:
        return {"type": kind}
    if kind == "object" and schema.get("properties"):
        fields = {name: _reduced(field, definitions, depth + 1) for name, field in schema["properties"].items()}
        return None if None in fields.values() else {"type": "object", "properties": fields}
    if kind == "array" and isinstance(schema.get("items"), dict):
        item = _reduced(schema["items"], definitions, depth + 1)
        return None if item is None or item["type"] == "array" else {"type": "array", "items": item}
    return None
