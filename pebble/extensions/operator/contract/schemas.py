"""JSON Schemas of every payload, generated from the contract, for programs in other languages.

They define what to *send*; Pebble reads more leniently (a bare boolean for sounds, an axis that is no number as 0).
Numbers of drive and light commands may be sent as text, as forms of web pages do; Pebble itself sends numbers.
"""

from typing import Any

import msgspec

from pebble.contract import CHANNELS, INCOMING, Channel
from pebble.contract.capabilities import CapabilitiesValue
from pebble.contract.payloads import Capabilities, Drive, LightsFlash, LightsSolid

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_REF = "#/$defs/{name}"
_BOOLEAN = {"type": "boolean"}
_NUMERIC = r"^\s*[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?\s*$"


def schemas() -> dict[str, Any]:
    """Return one document: ``topics`` maps ``incoming/drive-values`` to its schema, ``$defs`` holds the structs.

    Binary topics are absent. Limits that a schema cannot express (64 KB, NaN) are in docs/topics.md.
    """
    json_channels = [channel for channel in CHANNELS if channel.payload is not bytes]
    structs = list(dict.fromkeys(channel.payload for channel in json_channels if channel.payload is not bool))
    (offers, *roots), definitions = msgspec.json.schema_components([CapabilitiesValue, *structs], ref_template=_REF)
    definitions[Capabilities.__name__]["properties"]["value"] = offers  # the struct itself has any object there
    for struct in (Drive, LightsSolid, LightsFlash):
        for field in definitions[struct.__name__]["properties"].values():
            if field["type"] == "number":
                field |= {"type": ["number", "string"], "pattern": _NUMERIC}
    root_of = dict(zip(structs, roots, strict=True))
    topics = {channel.suffix: _accepted(channel, root_of.get(channel.payload, _BOOLEAN)) for channel in json_channels}
    return {"$schema": DIALECT, "title": "Pebble payloads", "topics": topics, "$defs": definitions}


def _accepted(channel: Channel, root: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of every accepted form: bare, and for incoming channels also wrapped."""
    if channel.payload is bool:
        return {"description": channel.doc, "anyOf": [root, _wrapped("value", root), _wrapped("enabled", root)]}
    if channel.direction == INCOMING:
        return {"description": channel.doc, "anyOf": [root, _wrapped("value", root)]}
    return {"description": channel.doc, **root}


def _wrapped(key: str, inner: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": {key: inner}, "required": [key]}
