"""`pebble fleet hub`: a hub that runs, and files that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.commands.command_line import Run, running
from tests.support import free_port, until


def hub_file(folder: Path, name: str, **settings: Any) -> Path:
    file = folder / f"{name}.json"
    file.write_text(json.dumps({"run_dir": str(folder / name), **settings}), encoding="utf-8")
    return file


def test_a_hub_names_where_it_listens(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with running("fleet", "hub", str(hub_file(tmp_path, "a", listen=[endpoint], journal="a.journal"))):
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
def test_a_file_that_cannot_work_is_refused(run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str) -> None:
    assert run("fleet", "hub", str(hub_file(tmp_path, "hub", **settings))) == 1
    assert complaint in run.err
