"""The files that are generated from the config sections: up to date, and agreeing with the reader."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pebble.extensions.checks.keys import keys_text
from tests.support import ROOT, some
from tools.schema import SCHEMA_FILE, schema_text

SCHEMA = json.loads(schema_text())
FILES = [
    *sorted(path for path in (ROOT / "configs").glob("*.json") if path.name != SCHEMA_FILE.name),
    ROOT / "tests" / "data" / "original-shaped-config.json",
]


def valid(config: Any) -> bool:
    return bool(jsonschema.Draft202012Validator(SCHEMA).is_valid(config))


def test_the_schema_is_one_and_up_to_date_and_names_no_folder_of_this_machine() -> None:
    assert (ROOT / SCHEMA_FILE).read_text() == schema_text(), "run: python tools/schema.py"
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert str(Path.home()) + "/" not in schema_text()
    assert str(ROOT) not in schema_text() + keys_text()


def test_the_schema_accepts_our_files() -> None:
    assert [path for path in some(FILES[::-1], 9) if not valid(json.loads(path.read_text()))] == []


@pytest.mark.parametrize(
    ("config", "accepted"),
    [
        ({"//": "why", "robot": {"id": "a", "// id": 1}}, True),
        (
            {"robot": {"id": "a"}, "services": {"mqtt_bridge": {"reboot_control": {"command": "sudo reboot"}}}},
            True,
        ),
        ({}, False),
        ({"robot": {"id": "a/b"}}, False),
        ({"robot": {"id": "a"}, "locale": 1}, False),
        ({"robot": {"id": "a"}, "transport": {}}, False),
        ({"robot": {"id": "a"}, "services": {"mqtt_bridge": {"topics": {"reboot": "a/#"}}}}, False),
        ({"robot": {"id": "a"}, "services": {"serial_mcu_bridge": {"instances": {"i": {"serail": {}}}}}}, False),
    ],
)
def test_the_schema_refuses_what_the_reader_refuses(config: Any, accepted: bool) -> None:
    assert valid(config) is accepted


def test_every_key_is_documented() -> None:
    documented = {name.rpartition(".")[2] for name in re.findall(r"^\| `([^`]+)` \|", keys_text(), re.MULTILINE)}
    keys = {key for section in SCHEMA["$defs"].values() for key, value in section["properties"].items()
            if not value.get("deprecated")}  # fmt: skip
    assert keys - documented == set()
