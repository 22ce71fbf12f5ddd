"""The generated documents are complete, and docs/topics.md shows payloads that are valid."""

from __future__ import annotations

import functools
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pebble import contract as c
from pebble.contract import CHANNELS, Channel, codec
from pebble.contract.payloads import ChargingLevel, Drive, Heartbeat, TouchSensors, TouchValues
from pebble.extensions.operator.contract import docs as topic_docs
from pebble.extensions.operator.contract.schemas import schemas
from tests.support import ROOT

PAGE = (ROOT / "docs" / "topics.md").read_text()
topics_document = functools.cache(topic_docs.topics_document)  # takes half a second


#: Rows of docs/topics.md: a topic below the robot, and an example in JSON.
ROWS = dict(re.findall(r"^\| `((?:incoming|outgoing)/[^`]+)` \|.*?(?:`([^`]+)`.*)?\|$", PAGE, re.MULTILINE))


def test_the_page_names_topics_of_the_contract_and_the_table_each() -> None:
    assert len(ROWS) > 20
    assert set(ROWS) <= {channel.suffix for channel in CHANNELS}
    assert [channel.suffix for channel in CHANNELS if f"| `{channel.suffix}` |" not in topics_document()] == []


@pytest.mark.parametrize("channel", [channel for channel in CHANNELS if ROWS.get(channel.suffix, "")[:1] in ("{", "t")])
def test_an_example_of_the_page_is_valid(channel: Channel) -> None:
    codec.decode(channel, ROWS[channel.suffix].encode())


def test_running_the_module_writes_the_files(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "pebble.extensions.operator.contract.docs", str(tmp_path)],
        cwd=ROOT,
        check=True,
        timeout=60,
    )
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == topic_docs.documents()


def test_every_link_leads_to_a_payload() -> None:
    text = topics_document()
    headings = {heading.lower() for heading in re.findall(r"^### (\w+)$", text, re.MULTILINE)}
    links = set(re.findall(r"\]\(#(\w+)\)", text))
    assert links <= headings
    assert {"drive", "touchvalues", "imuhealth"} <= links


@pytest.mark.parametrize(
    ("channel", "value"),
    [
        (c.DRIVE, Drive(x=0.5)),
        (c.MQTT_VIDEO, True),
        (c.ONLINE, Heartbeat(t=1710969600123)),
        (c.CHARGING_LEVEL, ChargingLevel(value=7.4)),
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
