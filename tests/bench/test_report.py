"""The page of a report, and that it is written even if comparisons fail."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console

from pebble.bench import bridge, control, report
from pebble.bench.report import SECTIONS, Section, text
from pebble.bench.results import Results
from pebble.bench.show import finish
from pebble.commands import bench
from pebble.errors import PebbleError
from pebble.rig.processes import children
from tests.bench import synthetic
from tests.support import ROOT, Child, gone, until

PLAN = (Section("control", "C", 1, 1), Section("startup", "S", 1, 1))


def put(folder: Path, results: Results, output: str) -> None:
    results.save(folder / f"{results.bench}.json")
    (folder / f"{results.bench}.txt").write_text(output)


def rows(page: str) -> dict[str, list[str]]:
    lines = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    return {first: [cell.strip() for cell in rest] for first, *rest in lines}


def test_mqtt_stands_beside_zenoh_and_the_stand_in_first(tmp_path: Path) -> None:
    for results in (synthetic.of_control(), synthetic.of_bridge()):
        put(tmp_path, results, "a table")
    page = text(tmp_path)
    assert page.index("| stand-in | mqtt | zenoh | zenoh / mqtt |") < page.index("## ")
    unit, stand_in, mqtt, zenoh, compared = rows(page)["command to the wheels, commands only"]
    assert unit == "ms"
    assert [float(value) for value in (stand_in, mqtt, zenoh)] == pytest.approx([2.0, 1.0, 1.1], rel=0.1)
    assert re.fullmatch(r"1\.\d\d \(\S+ to \S+\)|0\.9\d \(\S+ to \S+\)", compared)
    assert rows(page)["message between two services"][0] == "µs"
    assert "launch to ready" not in page


def test_a_section_has_its_command_its_pictures_and_its_tables_once(tmp_path: Path) -> None:
    shown = control.shown(synthetic.of_control())
    shown.results.began = "2026-11-20T14:00:00Z"
    shown.results.took_s = 61.0
    with (tmp_path / "control.txt").open("w") as output:
        finish(shown, tmp_path, Console(file=output, width=120))
    page = text(tmp_path)
    assert "## Service to service\n\nMeasures the latency of messages between two services" in page
    assert "\n    pebble bench control\n\nStarted 2026-11-20 14:00 UTC, 61 s.\n" in page
    links = re.findall(r"!\[[^]]+\]\(([^)]+)\)", page)
    assert links == ["control-one-way.png"]
    assert all((tmp_path / link).exists() for link in links)
    assert page.count("zenoh-p2p") == 2  # one row under each load
    assert "Written" not in page


def test_a_quick_run_is_marked_with_its_command(tmp_path: Path) -> None:
    results = bridge.shown(synthetic.of_bridge()).results
    put(tmp_path, results, "")
    assert "    pebble bench bridge --with-media\n" in text(tmp_path)
    assert "quick" not in text(tmp_path)
    results.quick = True
    put(tmp_path, results, "")
    assert text(tmp_path).startswith("# Results of a quick run\n")
    assert "    pebble bench bridge --quick\n" in text(tmp_path)


def test_what_ended_badly_is_no_whole_result(tmp_path: Path) -> None:
    results = synthetic.of_startup()
    results.complete = False
    put(tmp_path, results, "")
    (tmp_path / "cost.txt").write_text("pebble: mosquitto is missing")
    (tmp_path / "frames.json").write_text('{"bench": "frames", "format": 1}')
    (tmp_path / "frames.txt").write_text("of another version")
    page = text(tmp_path)
    assert "**Something could not be measured.**" in page
    assert page.count("**It failed, and left no results.**") == 2
    assert "pebble: mosquitto is missing" in page


def test_a_foreign_document_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# My robot")
    with pytest.raises(PebbleError, match=r"README\.md is not a report of pebble bench"):
        report.run(["startup"], tmp_path, quick=True, console=Console(quiet=True))
    assert (tmp_path / "README.md").read_text() == "# My robot"


def test_a_comparison_that_fails_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both command lines are invalid; results of an earlier run must not hide that."""
    monkeypatch.setattr(report, "SECTIONS", PLAN)
    monkeypatch.setattr(report, "_command", lambda section, _quick: ["bench", "nonsense", section.name])
    put(tmp_path, synthetic.of_control(), "old")
    console = Console(record=True, width=100)
    assert report.run(["control", "startup"], tmp_path, quick=True, console=console) == 1
    assert not (tmp_path / "control.json").exists()
    assert "No such command 'nonsense'" in (tmp_path / "README.md").read_text()
    assert "control ended with code 2" in console.export_text(clear=False)
    assert "startup ended with code 2" in console.export_text()


def test_an_interrupted_run_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_one(section: Section, folder: Path, _quick: bool) -> str:
        (folder / f"{section.name}.txt").touch()
        if section.name == "startup":
            raise KeyboardInterrupt
        put(folder, synthetic.of_control(), "a table")
        return ""

    monkeypatch.setattr(report, "run_one", run_one)
    with pytest.raises(KeyboardInterrupt):
        report.run(["control", "startup"], tmp_path, quick=True, console=Console(quiet=True))
    page = (tmp_path / "README.md").read_text()
    assert "a table" in page
    assert "**It failed, and left no results.**" in page


def test_a_hanging_comparison_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "_TIMEOUT_FACTOR", 0)
    monkeypatch.setattr(report, "_TIMEOUT_EXTRA_S", 0.0)
    console = Console(record=True, width=100)
    assert report.run(["startup"], tmp_path, quick=True, console=console) == 1
    assert "startup hung and was ended" in console.export_text()


@pytest.mark.parametrize(("user", "has_impair"), [(0, True), (1000, False)])
def test_without_root_impair_is_left_out(
    user: int, has_impair: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(report, "run_one", lambda section, *_: ran.append(section.name) or "")
    assert report.run((), tmp_path, quick=True, console=Console(quiet=True)) == 0
    assert ran == [section.name for section in SECTIONS][: None if has_impair else -1]


@pytest.mark.thorough
def test_ctrl_c_ends_the_comparison_that_runs(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pebble.cli", "bench", "report", str(tmp_path / "out"), "--only", "startup"]
    with Child(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert until(lambda: children(process.pid), 30)
        (child,) = children(process.pid)
        assert until(lambda: b"startup" in Path(f"/proc/{child}/cmdline").read_bytes())
        process.send_signal(signal.SIGTERM)
        assert process.wait(40) == 130
        assert until(lambda: gone(child), 20)


@pytest.mark.parametrize("quick", [False, True], ids=["full", "quick"])
@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_every_command_line_is_one_that_exists(section: Section, quick: bool) -> None:
    group, name, *options = report._command(section, quick)
    assert group == "bench"
    command = typer.main.get_command(bench.app).commands[name]  # type: ignore[attr-defined]
    command.make_context(name, [*options, "--output", "somewhere"])
