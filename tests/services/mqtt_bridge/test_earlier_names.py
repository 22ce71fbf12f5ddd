"""A robot that has another name than at its last start says so."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pebble.config import load
from pebble.services.mqtt_bridge.earlier_names import note_name


@pytest.mark.parametrize(
    ("names", "warnings"),
    [(["a"], 0), (["a", "a"], 0), (["a", "b", "b"], 1), (["a", "b", "a"], 2), (["a", "", "b"], 1)],
)
@pytest.mark.parametrize("folder", [None, "state"], ids=["default", "shared"])
def test_a_new_name_is_warned_of_once(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    names: list[str],
    warnings: int,
    folder: str | None,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    path = tmp_path / "robot.json"
    for name in filter(None, names):
        transport = {"kind": "zenoh"} if folder is None else {"kind": "zenoh", "state_dir": str(tmp_path / folder)}
        path.write_text(json.dumps({"robot": {"id": name}, "transport": transport}))
        note_name(load(path))
    before = [line for line in caplog.messages if "its name was pebble/robots/" in line]
    assert len(before) == len(caplog.messages) == warnings
