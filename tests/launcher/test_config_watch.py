"""A config file that changes while its robot runs: one warning, and nothing else."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.launcher.config_watch import ConfigWatch


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "password").write_text("hush")
    path = tmp_path / "rover.json"
    write(path)
    return path


def write(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({"robot": {"id": "rover"}, "local_mqtt": {"password_file": "password"}, **changes}))


def polls(watch: ConfigWatch, caplog: pytest.LogCaptureFixture, number: int = 3) -> list[str]:
    """What is logged during some polls; the file does not change between them."""
    caplog.clear()
    for _ in range(number):
        watch.poll()
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_change_is_one_warning_once_the_file_is_at_rest(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    watch = ConfigWatch(load(file))
    assert polls(watch, caplog) == []
    file.write_text('{"robot"')
    assert polls(watch, caplog, 1) == [], "an editor may still be writing it"
    write(file, log_level="DEBUG")
    (warning,) = polls(watch, caplog)
    assert warning == f"{file} has changed: the robot goes on with what it read when it started, until its next start"
    write(file, log_level="INFO")
    assert polls(watch, caplog) == []


def test_what_means_the_same_is_no_change(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    watch = ConfigWatch(load(file))
    data = json.loads(file.read_text())
    file.rename(file.with_suffix(".old"))
    file.write_text(json.dumps({"// why": "a comment", **data}, indent=4))
    assert polls(watch, caplog) == []


@pytest.mark.parametrize(
    "text",
    [
        "{",
        '{"robot": {"id": "rover"}, "robt": 1, "serv": 2}',
        '{"robot": {"id": "rover"}, "deep": ' + '{"a":' * 700 + "1" + "}" * 701,
        None,
    ],
    ids=["torn", "misspelt", "deep", "removed"],
)
def test_a_file_that_cannot_be_used_any_more_is_reported(
    file: Path, text: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    watch = ConfigWatch(load(file))
    file.unlink()
    file.with_suffix(".json" if text is not None else ".other").write_text(text or "")
    (warning,) = polls(watch, caplog)
    assert warning.startswith(f"{file} has changed: the robot goes on with what it read")
    assert "its next start would fail: " in warning
    assert "\n" not in warning
