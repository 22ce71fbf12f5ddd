"""The contract as an AsyncAPI 3.0 document, for the generators and viewers of that format."""

import json
import re
from typing import Any, Final

import msgspec

from pebble.contract import CHANNELS, INCOMING, Channel
from pebble.extensions.operator.contract.schemas import schemas

_DESCRIPTION: Final = (
    "What a component of type robots, or of any other type, sends and receives; docs/bridge.md says who decides what, "
    "and docs/your-robot.md how to build one. send and receive are the component's."
)
_LEVELS: Final = {
    "system": "The first level of all topics, such as pebble.",
    "type": "What it is: robots, infrastructure, people.",
    "id": "Which one it is.",
}


def document() -> str:
    """Return the text of asyncapi.yaml. Needs PyYAML."""
    all_schemas = schemas()
    described: dict[str, Any] = {
        "asyncapi": "3.0.0",
        "info": {"title": "Pebble", "version": "1.0.0", "description": _DESCRIPTION, "license": {"name": "MIT"}},
        "defaultContentType": "application/json",
        "channels": {_name(channel): _channel(channel, all_schemas["topics"]) for channel in CHANNELS},
        "operations": {_name(channel): _operation(channel) for channel in CHANNELS},
        "components": {
            "parameters": {name: {"description": text} for name, text in _LEVELS.items()},
            "schemas": all_schemas["$defs"],
        },
    }
    renamed = json.loads(json.dumps(described).replace('"#/$defs/', '"#/components/schemas/'))
    return "# Written by python -m pebble.extensions.operator.contract.docs.\n" + msgspec.yaml.encode(renamed).decode()


def _name(channel: Channel) -> str:
    """Return a channel's name, such as ``incoming.drive-values``; in it ``{uid}`` becomes ``uid``."""
    return channel.suffix.replace("/", ".").translate({ord("{"): None, ord("}"): None})


def _channel(channel: Channel, payloads: dict[str, Any]) -> dict[str, Any]:
    names = {name: {"description": f"Which {name}."} for name in re.findall(r"{(\w+)}", channel.metric)}
    levels = {name: {"$ref": f"#/components/parameters/{name}"} for name in _LEVELS}
    return {
        "address": f"{{system}}/{{type}}/{{id}}/{channel.suffix}",
        "description": channel.doc,
        "parameters": levels | names,
        "messages": {"message": _message(channel, payloads)},
    }


def _message(channel: Channel, payloads: dict[str, Any]) -> dict[str, Any]:
    if channel.payload is bytes:
        return {"contentType": "application/octet-stream", "payload": {"type": "string", "format": "binary"}}
    schema = payloads[channel.suffix]
    return {"payload": {key: value for key, value in schema.items() if key != "description"}}


def _operation(channel: Channel) -> dict[str, Any]:
    binding = {"qos": channel.default_qos, "retain": channel.default_retain, "bindingVersion": "0.2.0"}
    return {
        "action": "receive" if channel.direction == INCOMING else "send",
        "channel": {"$ref": f"#/channels/{_name(channel)}"},
        "summary": f"{channel.kind.name}: {channel.kind.meaning}",
        "bindings": {"mqtt": binding},
    }
