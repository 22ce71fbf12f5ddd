"""``pebble analyse``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands.command_line import Run
from tests.ext.recordings.synthetic import FLEET, Sent, traffic, write_recording
from tests.support import ROOT

pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")


MEDIA = (b"PBAT", b"PBVD")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.chdir(tmp_path)
    return Run(monkeypatch, capsys)


@pytest.fixture(scope="module")
def messages() -> list[Sent]:
    return traffic(FLEET[1:], seconds=20.0)


@pytest.fixture
def folder(tmp_path: Path, messages: list[Sent]) -> Path:
    media = [sent for sent in messages if sent.payload.startswith(MEDIA)]
    state = [sent for sent in messages if not sent.payload.startswith(MEDIA)]
    write_recording(tmp_path / "recordings" / "a.state.mcap", state)
    write_recording(tmp_path / "recordings" / "b.media.mcap.active", media, finished=False)
    return tmp_path / "recordings"


@pytest.mark.thorough
def test_a_folder_that_is_recorded_to(run, folder, tmp_path):
    assert run("analyse", folder) == 0
    lines = {line.split()[0]: line.split() for line in run.out.splitlines() if line.strip()}
    assert lines["fred"][-1] == "265.6"
    assert lines["Written:"][1] == "report/traffic.html"
    assert (tmp_path / "report" / "traffic.html").exists()
    assert run.err == ""


def test_some_robots_some_time_and_csv(run, folder, tmp_path):
    arguments = ["--robot", "fred", "-r", "pebble/robots/benjr", "--since", "2025-11-20T01:00:10", "--until", "+5s"]
    assert run("analyse", folder, *arguments, "--output", tmp_path / "out", "--csv") == 0
    rows = (tmp_path / "out" / "bandwidth.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"pebble/robots/fred", "pebble/robots/benjr"}
    heartbeats = next(row for row in rows if row.startswith("pebble/robots/benjr,MCU,heartbeat,all"))
    assert heartbeats.split(",")[7] == "20"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.mcap"], "missing.mcap: No such file or directory"),
        (["recordings", "--since", "soon"], '--since "soon" is no time: write 10:00,'),
        (["recordings", "--since", "2030-01-01"], "no message of a robot in this period"),
        (["recordings", "--robot", "a/b"], 'give its id, or "system/type/id"'),
        (["recordings", "--robot", "stranger"], "no robot pebble/robots/stranger in recordings; there are: "),
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


def test_a_name_does_not_control_the_terminal(run, tmp_path):
    write_recording(tmp_path / "x.mcap", [Sent(10**18, "pebble/robots/\u202egoob/outgoing/status", b"{}")])
    assert run("analyse", tmp_path / "x.mcap") == 0
    assert "\u202e" not in run.out
    assert "\\u202egoob" in run.out


def test_the_help_needs_no_large_package():
    names = (
        "commands.analyse",
        *(f"traffic.{part}" for part in ("analysis", "report", "sources")),
    )
    imports = "; ".join(f"import pebble.extensions.recordings.{name}" for name in names)
    code = f"{imports}; import sys; print(sorted({{'duckdb', 'matplotlib', 'numpy'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
