"""The files that are generated from the config sections: up to date, and agreeing with the reader."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pebble.extensions.checks.keys import keys_text
from tools.schema import SCHEMA_FILE, schema_text

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = json.loads(schema_text())
FILES = [
    *sorted(path for path in (ROOT / "configs").glob("*.json") if path.name != SCHEMA_FILE.name),
    ROOT / "tests" / "data" / "original-shaped-config.json",
]


def valid(config: Any) -> bool:
    return bool(jsonschema.Draft202012Validator(SCHEMA).is_valid(config))


def test_the_schema_is_up_to_date() -> None:
    assert (ROOT / SCHEMA_FILE).read_text() == schema_text(), "run: python tools/schema.py"


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_schema_accepts_our_files(path: Path) -> None:
    jsonschema.validate(json.loads(path.read_text()), SCHEMA)


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"robot": {}},
        {"robot": {"id": "a/b"}},
        {"robot": {"id": "a"}, "locale": 1},
        {"robot": {"id": "a"}, "local_mqtt": {"port": 0}},
        {"robot": {"id": "a"}, "transport": {}},
        {"robot": {"id": "a"}, "services": {"mqtt_bridge": {"topics": {"reboot": "a/#"}}}},
        {"robot": {"id": "a"}, "services": {"serial_mcu_bridge": {"instances": {"imu": {"serail": {}}}}}},
    ],
)
def test_the_schema_refuses_what_the_reader_refuses(config: Any) -> None:
    assert not valid(config)


def test_the_schema_allows_comments_and_commands_as_one_line() -> None:
    assert valid({"//": "why", "robot": {"id": "a", "// id": 1}})
    assert valid({"robot": {"id": "a"}, "services": {"mqtt_bridge": {"reboot_control": {"command": "sudo reboot"}}}})


def test_every_key_is_documented() -> None:
    documented = {name.rpartition(".")[2] for name in re.findall(r"^\| `([^`]+)` \|", keys_text(), re.MULTILINE)}
    keys = {key for section in SCHEMA["$defs"].values() for key, value in section["properties"].items()
            if not value.get("deprecated")}  # fmt: skip
    assert keys - documented == set()


def test_the_schema_and_the_docs_name_no_folder_of_this_machine() -> None:
    assert str(Path.home()) + "/" not in schema_text()
    assert str(ROOT) not in schema_text() + keys_text()
