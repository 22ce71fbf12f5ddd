"""A report is written even if comparisons fail, and each of its command lines exists."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import report
from pebble.extensions.lab.bench.report import SECTIONS, Section
from pebble.extensions.lab.bench.results import Results
from pebble.extensions.lab.commands import bench

PLAN = (Section("control", "C", 1, 1), Section("startup", "S", 1, 1))


def test_a_foreign_document_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# My robot")
    with pytest.raises(PebbleError, match=r"README\.md is not a report of pebble bench"):
        report.run(["startup"], tmp_path, quick=True, console=Console(quiet=True))
    assert (tmp_path / "README.md").read_text() == "# My robot"


def test_a_comparison_that_fails_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both command lines are invalid; results of an earlier run must not hide that."""
    monkeypatch.setattr(report, "SECTIONS", PLAN)
    monkeypatch.setattr(Section, "command", lambda section, _quick: ["bench", "nonsense", section.name])
    Results(bench="control").save(tmp_path / "control.json")
    console = Console(record=True, width=100)
    assert report.run(["control", "startup"], tmp_path, quick=True, console=console) == 1
    assert not (tmp_path / "control.json").exists()
    assert "No such command 'nonsense'" in (tmp_path / "README.md").read_text()
    assert "control ended with code 2" in console.export_text(clear=False)
    assert "startup ended with code 2" in console.export_text()


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_every_command_line_is_one_that_exists(section: Section) -> None:
    group, name, *options = section.command(quick=False)
    assert group == "bench"
    command = typer.main.get_command(bench.app).commands[name]  # type: ignore[attr-defined]
    command.make_context(name, [*options, "--output", "somewhere"])
