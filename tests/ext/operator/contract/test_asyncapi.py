"""The AsyncAPI document is valid for AsyncAPI's own schema, and has every channel."""

from __future__ import annotations

import json
from functools import reduce
from typing import Any

import jsonschema
import yaml

from pebble.contract import CHANNELS
from pebble.extensions.operator.contract.asyncapi import document
from tests.kit.npm import package


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
