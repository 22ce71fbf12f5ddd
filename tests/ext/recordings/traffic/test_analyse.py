"""``pebble analyse``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ext.recordings.demo_robots import BENJR, DRIVE, messages
from tests.ext.recordings.synthetic import demo_folder

pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.chdir(tmp_path)
    return demo_folder(tmp_path / "recordings")


def test_some_robots_some_time_and_csv(run, folder, tmp_path):
    arguments = ["--robot", "fred", "-r", "pebble/robots/benjr", "--since", "2026-11-22T23:46:05", "--until", "+5s"]
    assert run("analyse", folder, *arguments, "--output", tmp_path / "out", "--csv") == 0
    rows = (tmp_path / "out" / "bandwidth.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"pebble/robots/fred", "pebble/robots/benjr"}
    row = next(row for row in rows if row.startswith("pebble/robots/benjr,MCU,heartbeat,all"))
    since_ns = 1_795_391_165 * 10**9
    heartbeats = [one for one in messages(DRIVE) if one.channel.topic == f"{BENJR}/outgoing/online"]
    assert int(row.split(",")[7]) == sum(0 <= one.log_ns - since_ns < 5e9 for one in heartbeats)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.mcap"], "missing.mcap: No such file or directory"),
        (["recordings", "--since", "2030-01-01"], "no message of a robot in this period"),
        (["recordings", "--robot", "a/b"], 'give its id, or "system/type/id"'),
        (["recordings", "--output", "recordings/a.state.mcap"], "recordings/a.state.mcap: File exists"),
    ],
)
def test_what_is_wrong_is_one_line(run, folder, arguments, message):
    assert run("analyse", *arguments) == 1
    assert message in run.err
    assert len(run.err.splitlines()) == 1


def test_packages_that_are_missing_are_named(run, folder, monkeypatch):
    monkeypatch.setattr("pebble.extensions.recordings.traffic.duck.find_spec", lambda _name: None)
    assert run("analyse", folder) == 1
    assert run.err == 'pebble: duckdb and matplotlib missing: pip install "pebble-robot[archive]"\n'
