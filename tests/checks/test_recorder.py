"""What the doctor finds out about a robot's own recorder."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.checks.check import CheckResult, State
from pebble.checks.recorder import recorder
from pebble.config import parse
from pebble.recordings.recorder.folder import Folder
from tests.recordings.playing import GOOB, Line, js, ms, write

HOUR = "2023/11/14/20231114T221320Z-000001.state.mcap"
BEGAN = ms(0) / 1000


def findings(folder: Path, now: float = BEGAN + 1000, **section: Any) -> list[CheckResult]:
    robot = {"system": "pebble", "type": "robots", "id": "goob"}
    config = {"robot": robot, "services": {"recorder": {"enabled": True, "folder": str(folder), **section}}}
    return list(recorder(parse(config, folder=folder, env={}), now))


def recorded(folder: Path, *lines: Line, seconds: float = 900.0) -> Path:
    """A finished file that was written last after ``seconds``."""
    path = folder / HOUR
    path.parent.mkdir(parents=True, exist_ok=True)
    heartbeats = [Line(at, f"{GOOB}/outgoing/online", js(t=ms(at))) for at in (0.0, seconds)]
    write(path, sorted([*heartbeats, *lines], key=lambda line: line.at))
    os.utime(path, (BEGAN + seconds, BEGAN + seconds))
    return path


def running(folder: Path, **status: Any) -> Folder:
    owner = Folder(folder)
    owner.take()
    (folder / "recorder.json").write_text(json.dumps({"at": time.time(), "messages": 7, **status}))
    return owner


def test_a_robot_without_a_recorder_is_not_asked() -> None:
    robot = {"system": "pebble", "type": "robots", "id": "goob"}
    assert list(recorder(parse({"robot": robot}, folder=Path(), env={}))) == []


def test_a_folder_that_is_not_there_yet_is_fine(tmp_path: Path) -> None:
    (found,) = findings(tmp_path / "none")
    assert (found.state, "has not recorded anything" in found.text) == (State.OK, True)


def test_one_that_runs_and_one_that_does_not(tmp_path: Path) -> None:
    recorded(tmp_path)
    assert findings(tmp_path)[0].text == "does not run now"
    owner = running(tmp_path)
    found = findings(tmp_path, time.time())[0]
    assert (found.state, found.text) == (State.OK, f"runs, 7 messages into {tmp_path}")
    owner.release()


@pytest.mark.parametrize(
    ("status", "level", "text"),
    [
        ({"at": 1_700_000_000.0}, State.WARN, "has stood still for "),
        ({"blocked": "no room"}, State.FAILED, "writes nothing: no room"),
        ({"dropped": 12}, State.WARN, "has dropped 12 messages"),
    ],
)
def test_what_is_wrong_with_one_that_runs(tmp_path: Path, status: dict[str, Any], level: State, text: str) -> None:
    owner = running(tmp_path, **status)
    found = findings(tmp_path, time.time())[0]
    assert found.state is level
    assert text in found.text
    owner.release()


def test_files_that_were_left(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    path.rename(path.with_name(f"{path.name}.active"))
    found = findings(tmp_path)[0]
    assert (found.state, found.fix) == (State.WARN, f"pebble recordings mend {tmp_path}")


def test_without_the_package_it_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.checks.recorder.find_spec", lambda _: None)
    (found,) = findings(tmp_path)
    assert (found.state, found.fix) == (State.FAILED, 'pip install "pebble-robot[record]"')


def test_damaged_files_are_named(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    path.rename(path.with_name(f"{path.name}.damaged"))
    (found,) = [one for one in findings(tmp_path) if "damaged files are kept" in one.text]
    assert (found.state, f"{path}.damaged" in found.text) == (State.WARN, True)


def test_links_are_left_alone(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    path.unlink()
    path.symlink_to(tmp_path / "nowhere")
    assert all(found.state is State.OK for found in findings(tmp_path))
