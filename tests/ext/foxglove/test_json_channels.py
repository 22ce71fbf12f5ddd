"""The contract's schemas in the part of JSON Schema that Foxglove reads."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.contract import CHANNELS, IMU, OUTGOING, STATUS, Channel
from pebble.extensions.foxglove.json_channels import json_spec

TELEMETRY = [channel for channel in CHANNELS if channel.direction == OUTGOING and channel.payload is not bytes]


def check(schema: dict[str, Any]) -> None:
    """Parses as foxglove/studio does (packages/mcap-support/src/parseJsonSchema.ts), which refuses everything else."""
    assert schema["type"] == "object"
    for field in schema["properties"].values():
        items = field["items"] if field["type"] == "array" else field
        assert items["type"] in ("boolean", "string", "number", "integer", "object")
        if items["type"] == "object":
            check(items)


@pytest.mark.parametrize("channel", TELEMETRY, ids=lambda channel: channel.suffix)
def test_foxglove_reads_every_schema(channel: Channel) -> None:
    spec = json_spec("topic", channel)
    assert (spec.encoding, spec.schema_encoding) == ("json", "jsonschema")
    check(json.loads(spec.schema or b'{"type": "object", "properties": {}}'))


def test_a_schema_has_one_name() -> None:
    by_name: dict[str, set[bytes]] = {}
    for channel in TELEMETRY:
        spec = json_spec("topic", channel)
        by_name.setdefault(spec.schema_name, set()).add(spec.schema)
    assert {name for name, schemas in by_name.items() if len(schemas) > 1} == set()
    assert len(by_name) > 5


def test_a_payload_that_no_schema_covers_may_be_any_json() -> None:
    assert json_spec("topic", STATUS)[2:] == ("pebble.Any", "jsonschema", b"")
    assert json_spec("topic", None)[2:] == ("pebble.Any", "jsonschema", b"")
    assert "orientation_deg" in json.loads(json_spec("topic", IMU).schema)["properties"]["value"]["properties"]
