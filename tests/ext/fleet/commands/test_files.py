"""`pebble fleet hub` and `pebble fleet gateway`: a hub that runs, and files that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.commands.command_line import Run, running
from tests.support import free_port, until

HUB = {"connect": ["tcp/127.0.0.1:1"]}
LAMP, BOARDS = "pebble/robots/minilamp", {"id": "g", "hub": {}, "boards": {}}


def written(folder: Path, name: str, **settings: Any) -> Path:
    file = folder / name
    file.write_text(json.dumps(settings), encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "gate.json: id: is missing: write what this gateway is called, such as gate-1"),
        ({"id": "a/b"}, "gate.json: id: must be a topic level"),
        ({"id": "g", "hub": {}}, "gate.json: hub.connect: is missing: write where the hub listens"),
        ({"id": "g", "mqtt": {"hosts": ["a", "b"]}}, "gate.json: mqtt: hosts is no key any more"),
        ({"id": "g", "robots": []}, "gate.json: robots: is empty"),
        ({"id": "g", "robots": ["pebble/gateways/+"]}, "'pebble/gateways/+' is no base"),
        ({"id": "g", "boards": {}}, "gate.json: boards: must be left out beside hub"),
        ({"id": "g", "hub": {}, "boards": {"host": "localhost"}}, "gate.json: mqtt: is also boards"),
        ({"id": "g", "neighbours": {LAMP: {"lan": HUB}}}, "gate.json: neighbours: must be left out without boards"),
        ({**BOARDS, "neighbours": {"pebble/robots/+": {"lan": HUB}}}, "'pebble/robots/+' is no base"),
        ({**BOARDS, "neighbours": {LAMP: {}}}, f"gate.json: neighbours.{LAMP}.lan.connect: is missing"),
        ({**BOARDS, "neighbours": {LAMP: {"lan": HUB, "listens": {"a": []}}}}, f"{LAMP}.listens: must be left out"),
        ({**BOARDS, "neighbours": {f"a/b/c{n}": {"lan": HUB} for n in range(17)}}, "has 17 robots: 16 are the most"),
    ],
)
def test_a_gateway_that_cannot_work_is_refused(
    run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str
) -> None:
    assert run("fleet", "gateway", written(tmp_path, "gate.json", **{"hub": HUB, **settings})) == 1
    assert complaint in run.err


# -- hubs


def test_a_hub_names_where_it_listens(tmp_path: Path) -> None:
    settings = {"run_dir": str(tmp_path / "a"), "listen": [f"tcp/127.0.0.1:{free_port()}"], "journal": "a.journal"}
    with running("fleet", "hub", written(tmp_path, "a.json", **settings)):
        assert until((tmp_path / "a" / "hub.sock").exists)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, 'hub.json: listen: is missing: a hub is reached there, such as ["tls/0.0.0.0:7447"]'),
        ({"listen": ["tcp/127.0.0.1:1"], "lisen": []}, 'hub.json: lisen: unknown key, did you mean "listen"?'),
        ({"listen": ["tcp/127.0.0.1:1"], "max_wills": 0}, "hub.json: max_wills: "),
        ({"listen": ["tcp/192.0.2.1:7447"]}, "leaves this machine unencrypted: use tls/host:port"),
    ],
)
def test_a_hub_that_cannot_work_is_refused(run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str) -> None:
    assert run("fleet", "hub", written(tmp_path, "hub.json", run_dir=str(tmp_path / "hub"), **settings)) == 1
    assert complaint in run.err
