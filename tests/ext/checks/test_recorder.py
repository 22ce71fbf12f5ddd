"""What the doctor finds out about a robot's own recorder."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import CheckResult, State
from pebble.config import parse
from pebble.extensions.recordings.recorder.folder import Folder
from pebble.services.recorder.checks import checks as recorder
from tests.ext.recordings.playing import GOOB, Line, js, ms, write

HOUR = "2023/11/14/20231114T221320Z-000001.state.mcap"


def findings(folder: Path, *, enabled: bool = True) -> list[CheckResult]:
    robot = {"system": "pebble", "type": "robots", "id": "goob"}
    config = {"robot": robot, "services": {"recorder": {"enabled": enabled, "folder": str(folder)}}}
    return list(recorder(parse(config, folder=folder, env={})))


def recorded(folder: Path) -> Path:
    """A finished file."""
    path = folder / HOUR
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, [Line(at, f"{GOOB}/outgoing/online", js(t=ms(at))) for at in (0.0, 900.0)])
    return path


def test_one_that_has_not_recorded_and_one_that_does_not_run(tmp_path: Path) -> None:
    (finding,) = findings(tmp_path / "none")
    assert (finding.state, "has not recorded anything" in finding.text) == (State.OK, True)
    recorded(tmp_path)
    assert findings(tmp_path)[0].text == "does not run now"


@pytest.mark.parametrize(
    ("status", "state", "text"),
    [
        ({}, State.OK, "runs, 7 messages into "),
        ({"at": 1_700_000_000.0}, State.WARN, "has stood still for "),
        ({"blocked": "no room"}, State.FAILED, "writes nothing: no room"),
        ({"dropped": 12}, State.WARN, "has dropped 12 messages"),
    ],
)
def test_one_that_runs(tmp_path: Path, status: dict[str, Any], state: State, text: str) -> None:
    with Folder(tmp_path).taken():
        (tmp_path / "recorder.json").write_text(json.dumps({"at": time.time(), "messages": 7, **status}))
        finding = findings(tmp_path)[0]
    assert (finding.state, text in finding.text) == (state, True)


@pytest.mark.parametrize(
    ("end", "fix"), [("active", "pebble recordings mend {}"), ("damaged", "pebble recordings rm FILE deletes one")]
)
def test_files_that_were_left(tmp_path: Path, end: str, fix: str) -> None:
    path = recorded(tmp_path)
    path.rename(path.with_name(f"{path.name}.{end}"))
    finding, *_ = [finding for finding in findings(tmp_path) if finding.state is State.WARN]
    assert finding.fix == fix.format(tmp_path)
