"""The generated documents are complete, and docs/topics.md shows payloads that are valid."""

from __future__ import annotations

import functools
import json
import re
from functools import reduce
from typing import Any

import jsonschema
import pytest
import yaml

from pebble import contract as c
from pebble.contract import CHANNELS, Channel, codec
from pebble.contract.payloads import Drive, TouchSensors, TouchValues
from pebble.extensions.operator.contract.asyncapi import document
from pebble.extensions.operator.contract.docs import topics_document
from pebble.extensions.operator.contract.schemas import schemas
from tests.kit.npm import package
from tests.support import ROOT

PAGE = (ROOT / "docs" / "topics.md").read_text()
#: Rows of docs/topics.md: a topic below the robot, and an example in JSON.
ROWS = dict(re.findall(r"^\| `((?:incoming|outgoing)/[^`]+)` \|.*?(?:`([^`]+)`.*)?\|$", PAGE, re.MULTILINE))


def test_the_page_names_topics_of_the_contract_and_the_table_each() -> None:
    assert len(ROWS) > 20
    assert set(ROWS) <= {channel.suffix for channel in CHANNELS}
    table = topics_document()
    assert [channel.suffix for channel in CHANNELS if f"| `{channel.suffix}` |" not in table] == []
    assert "| `incoming/flags/mqtt-video` | last change;" in table


@pytest.mark.parametrize("channel", [channel for channel in CHANNELS if ROWS.get(channel.suffix, "")[:1] in ("{", "t")])
def test_an_example_of_the_page_is_valid(channel: Channel) -> None:
    codec.decode(channel, ROWS[channel.suffix].encode())


@pytest.mark.parametrize(
    ("channel", "value"),
    [
        (c.DRIVE, Drive(x=0.5)),
        (c.MQTT_VIDEO, True),
        (c.TOUCH_SENSORS, TouchSensors(value=TouchValues(a0=1, a1=2, a2=3))),
    ],
    ids=lambda value: getattr(value, "metric", ""),
)
def test_what_is_published_follows_the_schema(channel: Channel, value: object) -> None:
    document = checked_schemas()
    schema = jsonschema.Draft202012Validator({"$defs": document["$defs"], **document["topics"][channel.suffix]})
    schema.validate(json.loads(codec.encode(channel, value)))
    with pytest.raises(jsonschema.ValidationError):
        schema.validate([])


@functools.cache
def checked_schemas() -> dict[str, Any]:
    document = schemas()
    for schema in ({"$defs": document["$defs"]}, *document["topics"].values()):
        jsonschema.Draft202012Validator.check_schema(schema)
    return document


# -- the AsyncAPI document


def at(whole: Any, reference: str) -> Any:
    """Return the part of a document that a reference names; raises KeyError."""
    keys = [key.replace("~1", "/").replace("~0", "~") for key in reference.removeprefix("#/").split("/")]
    return reduce(lambda part, key: part[key], keys, whole)


def test_it_is_valid_and_has_every_channel() -> None:
    schema = json.loads((package("@asyncapi/specs") / "schemas" / "3.0.0-without-$id.json").read_text())
    whole = yaml.safe_load(document())
    jsonschema.Draft7Validator(schema).validate(whole)
    actions = {"incoming": "receive", "outgoing": "send"}
    levels = "{system}/{type}/{id}"
    operations = whole["operations"].values()
    assert [(at(whole, one["channel"]["$ref"])["address"], one["action"]) for one in operations] == [
        (f"{levels}/{one.suffix}", actions[one.direction]) for one in CHANNELS
    ]
