"""The course of the trials, with robots that only send scripted reports."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import Run
from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.metrics import OperatorReport, Record, Window
from pebble.bench.impair.network import Traffic
from pebble.bench.impair.trials import IMPAIR, SUBJECTS, ImpairedRobot
from pebble.bench.results import load
from pebble.errors import PebbleError
from tests.bench.found import found

S = 1_000_000_000
PHASES = ("alone", "video", "video off", "audio", "audio off")
NOTHING = Record(
    commands=[],
    heartbeats=[],
    pictures=[],
    sounds=[],
    windows={phase: Window(number * S, (number + 1) * S) for number, phase in enumerate(PHASES)},
    clip_ns=5 * S,
)
TRIAL = [OperatorReport(phase=phase) for name in PHASES for phase in (name, "")] + [OperatorReport(record=NOTHING)]


class QuietNetwork:
    def __init__(self, log: list[str], name: str) -> None:
        self._log, self._name = log, name

    def apply(self, condition: Condition) -> None:
        self._log.append(f"{self._name}: {condition.name}")

    def traffic(self) -> Traffic:
        return Traffic()


class FakeOperator:
    """Reports ``trials`` trials, then nothing."""

    def __init__(self, log: list[str], trials: int) -> None:
        self._log = log
        printed = [OperatorReport(), *(one for _ in range(trials) for one in (OperatorReport(), *TRIAL))]
        self._reports = iter(printed)

    def send(self, _line: str) -> None: ...

    def answer(self, timeout: float) -> Any:
        for report in self._reports:
            return msgspec.to_builtins(report)
        raise PebbleError(f"the operator said nothing for {timeout:.0f} s")

    def ask_to_end(self) -> None:
        self._log.append("hurry")


def fake_robots(log: list[str], trials: int) -> Callable[[Run], AbstractContextManager[list[ImpairedRobot]]]:
    """Replaces pebble.bench.impair.trials.robots."""
    nothing = SimpleNamespace(
        programs=[], lines=lambda _since: [], log=lambda: "", folder=Path("/nowhere"), ended=False
    )

    def fake(subject: str) -> ImpairedRobot:
        parts: Any = (QuietNetwork(log, subject), nothing, nothing, FakeOperator(log, trials))
        return ImpairedRobot(subject, *parts, limit_s=30)

    return lambda run: nullcontext([fake(subject) for subject in SUBJECTS if subject in run["variants"]])


def go(monkeypatch: pytest.MonkeyPatch, folder: Path, trials: int) -> tuple[list[str], str]:
    log: list[str] = []
    printed = io.StringIO()
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)  # no plots
    monkeypatch.setattr("pebble.bench.impair.network.why_no_namespaces", lambda: None)
    run = replace(IMPAIR, measuring=replace(IMPAIR.measuring, environment=fake_robots(log, trials))).run_of(
        trials=["1024k", "5%"],
        variants=["mqtt original", "zenoh original", "mqtt h264 opus"],
        output=folder,
        console=Console(file=printed, width=120),
    )
    try:
        engine.run(run)
    except PebbleError as error:
        log.append(str(error))
    return log, printed.getvalue()


def test_each_group_runs_each_condition_and_then_a_clean_network(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log, _ = go(monkeypatch, tmp_path, trials=2)
    pair, single = ("mqtt original", "zenoh original"), ("mqtt h264 opus",)
    turns = [(pair, "1024k"), (single, "1024k"), (single, "5%"), (pair, "5%")]  # the last one comes first
    expected = [sorted(f"{one}: {what}" for one in group) for group, name in turns for what in (name, "clean")]
    applied = iter(log)
    assert [sorted(islice(applied, len(group))) for group in expected] == expected
    assert list(applied) == ["hurry"] * 3


def test_the_file_records_the_conditions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    go(monkeypatch, tmp_path, trials=2)
    results = load(tmp_path / "impair.json")
    assert (results.bench, results.options["window_s"]) == ("impair", 8.0)
    marks = [mark.partition("@")[0] for mark in str(results.options["marks"]).split(";")]
    assert marks == ["1024k", "5%"]
    assert {len(cell.rounds) for cell in results.cells if "trial" in cell.params} == {1}
    assert {len(cell.rounds) for cell in results.cells if "trial" not in cell.params} <= {2}  # curves


def test_without_namespaces_it_does_not_begin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pebble.bench.impair.network.why_no_namespaces", lambda: "not permitted")
    with pytest.raises(PebbleError, match="no network namespaces: not permitted"):
        engine.run(IMPAIR.run_of(output=tmp_path))


def test_a_robot_that_fails_ends_the_run_and_costs_no_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, _ = go(monkeypatch, tmp_path, trials=1)
    assert log[-1].startswith("the trials ended early: ")
    assert log[-1].endswith(" said nothing for 30 s")
    results = load(tmp_path / "impair.json")
    assert found(results, "mqtt h264 opus", trial="1024k") is not None
    assert results.assessment[0] == log[-1].replace("the trials", "The trials")


def test_robots_that_fail_at_once_leave_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, printed = go(monkeypatch, tmp_path, trials=0)
    assert log[0] == "hurry"
    assert log[-1] == "mqtt original: the operator said nothing for 30 s"
    assert "trial" not in printed
    assert not (tmp_path / "impair.json").exists()
