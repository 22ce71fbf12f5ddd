"""`pebble fleet gateway`: files that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet.gateway.gateway_file import load_gateway
from tests.commands.command_line import Run

HUB = {"connect": ["tcp/127.0.0.1:1"]}
LAMP, BOARDS = "pebble/robots/minilamp", {"id": "g", "hub": {}, "boards": {}}


def gateway_file(folder: Path, **settings: Any) -> Path:
    file = folder / "gate.json"
    file.write_text(json.dumps({"hub": HUB, **settings}), encoding="utf-8")
    return file


def test_it_is_called_as_its_account_unless_it_has_an_id(tmp_path: Path) -> None:
    named = load_gateway(gateway_file(tmp_path, mqtt={"username": "gate-1", "password": "x"}))
    both = load_gateway(gateway_file(tmp_path, id="hall", mqtt={"username": "gate-1", "password": "x"}))
    assert [named[1], both[1]] == ["gate-1", "hall"]
    assert named[0].robots == ("pebble/robots/+",)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "gate.json: id: is missing: write what this gateway is called, such as gate-1"),
        ({"id": "a/b"}, "gate.json: id: must be a topic level"),
        ({"id": "g", "hub": {}}, "gate.json: hub.connect: is missing: write where the hub listens"),
        ({"id": "g", "hub": {**HUB, "listen": HUB["connect"]}}, "gate.json: hub.listen: must be left out"),
        ({"id": "g", "mqtt": {"hosts": ["a", "b"]}}, "gate.json: mqtt: hosts is no key any more"),
        ({"id": "g", "robots": []}, "gate.json: robots: is empty"),
        ({"id": "g", "robots": ["pebble/robots"]}, "'pebble/robots' is no base: write SYSTEM/TYPE/ID"),
        ({"id": "g", "robots": ["pebble/gateways/+"]}, "'pebble/gateways/+' is no base"),
        ({"id": "g", "boards": {}}, "gate.json: boards: must be left out beside hub"),
        ({"id": "g", "hub": {}, "boards": {"hosts": ["a", "b"]}}, "gate.json: boards: hosts is no key any more"),
        ({"id": "g", "hub": {}, "boards": {"host": "localhost"}}, "gate.json: mqtt: is also boards"),
        ({"id": "g", "neighbours": {LAMP: {"lan": HUB}}}, "gate.json: neighbours: must be left out without boards"),
        ({**BOARDS, "neighbours": {"pebble/robots/+": {"lan": HUB}}}, "'pebble/robots/+' is no base"),
        ({**BOARDS, "neighbours": {LAMP: {}}}, f"gate.json: neighbours.{LAMP}.lan.connect: is missing"),
        ({**BOARDS, "neighbours": {LAMP: {"lan": HUB, "listens": {"a": []}}}}, f"{LAMP}.listens: must be left out"),
        ({**BOARDS, "neighbours": {f"a/b/c{n}": {"lan": HUB} for n in range(17)}}, "has 17 robots: 16 are the most"),
        ({"id": "g", "robot": ["pebble/robots/+"]}, 'gate.json: robot: unknown key, did you mean "robots"?'),
    ],
)
def test_a_file_that_cannot_work_is_refused(run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str) -> None:
    assert run("fleet", "gateway", str(gateway_file(tmp_path, **settings))) == 1
    assert complaint in run.err
