"""The text of a report, and that it is written even if comparisons fail."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import typer
from rich.console import Console

from pebble.bench import report
from pebble.bench.comparison import Budget, Comparison, chosen, reported
from pebble.bench.report import Section, text
from pebble.bench.results import Judged, Results
from pebble.commands import bench, impair
from pebble.errors import PebbleError
from pebble.rig.processes import children
from tests.bench import synthetic
from tests.support import ROOT, Child, gone, until


def section(name: str, results: Results | None = None, output: str = "") -> Section:
    return Section(comparison=chosen([name])[0], results=results, output=output)


def comparison(name: str, *arguments: str) -> Comparison:
    budget = Budget(1)
    return Comparison(name=name, title=name, what="", full=budget, quick=budget, words=arguments)


def put(folder: Path, results: Results, output: str) -> None:
    results.save(folder / f"{results.bench}.json")
    (folder / f"{results.bench}.txt").write_text(output)


def test_aims_of_all_comparisons_stand_in_one_table() -> None:
    missed = Judged(what="p50 | p99", outcome="missed", measured="0.9 ms")
    aims = [missed, Judged(what="bytes", outcome="met", measured="0")]
    bridge = Results(bench="bridge", aims=aims)
    lines = text([section("control", synthetic.control(small=True)), section("bridge", bridge)]).splitlines()
    assert [line for line in lines if line.startswith("| ") and "](#" in line] == [
        "| Zenoh peer to peer, p50 at most 0.70 of the better MQTT variant's | [control](#service-to-service) | met "
        "| 0.43, at most 0.45 |",
        "| with media, p99 at 200 Hz at most 0.35 of it | [control](#service-to-service) | **missed** "
        "| 0.41, at most 0.52 |",
        "| p50 \\| p99 | [bridge](#operator-to-wheels-and-back) | **missed** | 0.9 ms |",
        "| bytes | [bridge](#operator-to-wheels-and-back) | met | 0 |",
    ]


def test_the_most_important_sentence_comes_first() -> None:
    document = text([section("control", synthetic.control(small=True))])
    first = "* [Service to service](#service-to-service): p50: zenoh-p2p takes 0.43× the time of mqtt-nodelay"
    assert document.index(first) < document.index("## Aims")


def test_the_report_of_this_repository_begins_with_two_pictures_and_five_sentences() -> None:
    document = (ROOT / "docs" / "results" / "README.md").read_text()
    first = document[: document.index("## Aims")].splitlines()
    assert [sum(line.startswith(beginning) for line in first) for beginning in ("![", "* ")] == [2, 5]


def test_an_aim_that_was_not_judged_is_neither_met_nor_missed() -> None:
    aim = Judged(what="p50 at most 0.7 ms", outcome="not judged", measured="0.6 ms")
    few = Results(bench="bridge", aims=[aim])
    written = text([section("bridge", few)])
    assert "| p50 at most 0.7 ms | [bridge](#operator-to-wheels-and-back) | not judged | 0.6 ms |" in written


def test_a_table_appears_once_and_the_assessment_is_not_repeated() -> None:
    document = "conditions  p50\n40 B  12.0\nzenoh is faster\nWritten: a, b\n"
    results = Results(
        bench="control", assessment=["zenoh is faster"], command=["pebble", "bench", "control", "--rounds", "3"]
    )
    written = text([section("control", results, document)])
    assert "```text\nconditions  p50\n40 B  12.0\n```" in written
    assert written.count("zenoh is faster") == 1
    assert "    pebble bench control --rounds 3\n" in written
    assert "Written" not in written


def test_long_tables_are_folded() -> None:
    assert "<details><summary>The tables, 100 lines" in text(
        [section("control", Results(bench="control"), "row\n" * 100)]
    )


def test_a_failed_comparison_is_named_with_its_output() -> None:
    written = text(
        [section("control", Results(bench="control")), section("bridge", None, "pebble: mosquitto is missing")]
    )
    assert "* [Operator to wheels, and back](#operator-to-wheels-and-back): **failed**" in written
    assert "pebble: mosquitto is missing" in written


def test_a_quick_run_is_marked_with_its_limits() -> None:
    quick, full = (section("startup", Results(bench="startup", quick=quick)) for quick in (True, False))
    sound = section("sound", Results(bench="sound"))  # is as long in either
    assert "# Results of a quick run" in text([quick, sound])
    assert "quick" not in text([full]).lower()


def test_what_ended_badly_is_no_whole_result() -> None:
    """It wrote results, but something is missing."""
    one = synthetic.startup()
    assert "incomplete" not in text([section("startup", one)])
    one.complete = False
    assert "[Start-up](#start-up): **incomplete**" in text([section("startup", one)])
    assert "**Something could not be measured.**" in text([section("startup", one)])


def test_the_times_of_the_run_are_shown() -> None:
    written = text([section("startup", synthetic.startup())])
    assert "Measured on 2026-11-20, in 1 min 1 s." in written
    assert "Started 2026-11-20 14:00 UTC, 1 min 1 s." in written


@pytest.mark.thorough
def test_render_writes_all_again_from_what_is_there(tmp_path: Path) -> None:
    put(tmp_path, synthetic.startup(), "a table")
    put(tmp_path, synthetic.null_test("frames", "zenoh-shm"), "another table")
    (tmp_path / "sound.txt").write_text("Opus needs PyAV")
    written = report.write(tmp_path).read_text()
    links = re.findall(r"!\[[^]]+\]\(([^)]+)\)", written)
    assert links == ["startup.png", "frames-null-ratios.png", "frames-null-one-way.png"]
    assert all((tmp_path / link).exists() for link in links)
    headings = re.findall(r"^## (.+)$", written, re.MULTILINE)
    assert headings[2:] == [
        "Start-up", "Camera frames inside the robot: the null test", "Sound on the wire",
        "What these numbers do not show",
    ]  # fmt: skip
    anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([^)]+)\)", written)) <= anchors


def test_results_of_another_version_do_not_keep_the_others_out(tmp_path: Path) -> None:
    put(tmp_path, synthetic.startup(), "a table")
    (tmp_path / "cost.json").write_text('{"bench": "cost", "format": 0}')
    written = report.write(tmp_path).read_text()
    assert "startup.png" in written
    assert "cost.json has format 0, this pebble reads 1: measure again" in written


def test_a_foreign_document_is_not_overwritten(tmp_path: Path) -> None:
    put(tmp_path, synthetic.startup(), "a table")
    (tmp_path / "README.md").write_text("# My robot")
    with pytest.raises(PebbleError, match=r"README\.md is not a report of pebble bench"):
        report.write(tmp_path)
    with pytest.raises(PebbleError, match=r"README\.md is not a report of pebble bench"):
        report.run([comparison("sound", "bench", "sound")], tmp_path, quick=True, console=Console(quiet=True))
    assert (tmp_path / "README.md").read_text() == "# My robot"


def test_nothing_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="has no results"):
        report.write(tmp_path)


def test_a_comparison_that_fails_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both command lines are invalid; results of an earlier run must not hide that."""
    plan = [comparison("control", "bench", "nonsense"), comparison("sound", "topics")]
    monkeypatch.setattr(report, "reported", lambda: plan)
    put(tmp_path, synthetic.control(small=True), "old")
    console = Console(record=True, width=100)
    assert report.run(plan, tmp_path, quick=True, console=console) == 1
    assert not (tmp_path / "control.json").exists()
    assert "No such command 'nonsense'" in (tmp_path / "README.md").read_text()
    assert "No such option" in (tmp_path / "README.md").read_text()
    document = console.export_text()
    assert "control ended with code 2: see" in document
    assert "sound ended with code 2: see" in document


def test_an_interrupted_run_is_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = [comparison("sound", "bench", "sound"), comparison("startup", "bench", "startup")]
    monkeypatch.setattr(report, "reported", lambda: plan)
    ran: list[str] = []

    def run(one: Comparison, folder: Path, *_: object) -> str:
        ran.append(one.name)
        (folder / f"{one.name}.txt").touch()
        if one.name == "startup":
            raise KeyboardInterrupt
        put(folder, synthetic.sound(), "a table")
        return ""

    monkeypatch.setattr(report, "run_one", run)
    with pytest.raises(KeyboardInterrupt):
        report.run(plan, tmp_path, quick=True, console=Console(quiet=True))
    assert ran == ["sound", "startup"]
    written = (tmp_path / "README.md").read_text()
    assert "sound-wire.png" in written
    assert "**It failed, and left no results.**" in written


def test_a_hanging_comparison_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "TIMEOUT_FACTOR", 0)
    monkeypatch.setattr(report, "TIMEOUT_EXTRA_S", 0.0)
    plan = [comparison("fleet", "bench", "fleet")]
    monkeypatch.setattr(report, "reported", lambda: plan)
    console = Console(record=True, width=100)
    assert report.run(plan, tmp_path, quick=True, console=console) == 1
    assert "fleet hung and was ended" in console.export_text()


@pytest.mark.thorough
def test_a_successful_comparison_runs_its_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = [comparison("sound", "bench", "sound")]
    monkeypatch.setattr(report, "reported", lambda: plan)
    assert report.run(plan, tmp_path, quick=False, console=Console(quiet=True)) == 0
    written = (tmp_path / "README.md").read_text()
    assert "    pebble bench sound\n" in written
    assert re.search(r"24 kbit/s +1 part ", written)
    assert "\x1b" not in (tmp_path / "sound.txt").read_text()


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
@pytest.mark.parametrize("one", reported(), ids=lambda one: one.name)
def test_every_command_line_is_one_that_exists(one: Comparison, quick: bool) -> None:
    app = typer.Typer()
    app.callback()(lambda: None)
    bench.register(app)
    impair.register(app)
    parse(typer.main.get_command(app), [*one.arguments(quick), "--output", "somewhere"])


def parse(command: object, words: Sequence[str]) -> None:
    """Parses a whole command line without running it."""
    while True:
        context = command.make_context("pebble", list(words))  # type: ignore[attr-defined]
        if not hasattr(command, "resolve_command"):
            return
        rest = [*context._protected_args, *context.args]
        _, command, words = command.resolve_command(context, rest)


def test_unknown_names_are_an_error_and_no_names_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [one.name for one in chosen(["impair", "control"])] == ["control", "impair"]
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert [one.name for one in reported() if one not in chosen([])] == ["impair-thin"]  # an hour on its own
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert [one.name for one in reported() if one not in chosen([])] == ["bridge-profile", "impair", "impair-thin"]
    with pytest.raises(PebbleError, match=r"there is no nonsense in the report: there are control, "):
        chosen(["nonsense"])


def test_the_expected_times_are_as_documented() -> None:
    usual = [one for one in reported() if not one.by_name]
    assert sum(one.expected_s(quick=False) for one in usual) <= 95 * 60
    assert sum(one.expected_s(quick=True) for one in usual) < 330


def test_no_robot_and_no_command_loads_matplotlib() -> None:
    program = (
        "import sys; sys.argv = ['pebble', 'bench', '--help']; from pebble.cli import main; main(); "
        "import pebble.bench.engine, pebble.bench.report, pebble.launcher.programs, pebble.runtime.service; "
        "sys.exit('matplotlib' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, check=False, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
