"""The course of the trials, with robots that only send scripted reports."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair import trials as module
from pebble.extensions.lab.bench.impair.conditions import Condition
from pebble.extensions.lab.bench.impair.metrics import DRIVE, OperatorReport, Record, Window
from pebble.extensions.lab.bench.impair.trials import SUBJECTS, ImpairedRobot, Settings, run
from pebble.extensions.lab.bench.results import Results

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

    def bytes_up(self) -> int:
        return 0


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


def fake_robots(log: list[str], trials: int) -> Callable[[Settings], AbstractContextManager[list[ImpairedRobot]]]:
    """Replaces pebble.extensions.lab.bench.impair.trials.robots."""
    nothing = SimpleNamespace(
        programs=[], lines=lambda _since: [], log=lambda: "", folder=Path("/nowhere"), ended=False
    )

    def fake(subject: str) -> ImpairedRobot:
        parts: Any = (QuietNetwork(log, subject), nothing, nothing, FakeOperator(log, trials))
        return ImpairedRobot(subject, *parts, limit_s=30)

    return lambda settings: nullcontext([fake(subject) for subject in SUBJECTS if subject in settings.subjects])


def go(monkeypatch: pytest.MonkeyPatch, trials: int) -> tuple[list[str], Results]:
    log: list[str] = []
    monkeypatch.setattr(module, "robots", fake_robots(log, trials))
    monkeypatch.setattr("pebble.extensions.lab.bench.impair.network.why_no_namespaces", lambda: None)
    settings = Settings(trials=("1024k", "5%"), subjects=("mqtt original", "zenoh original", "mqtt h264 opus"))
    return log, run(settings, Console(file=io.StringIO())).results


def test_each_group_runs_each_condition_and_then_a_clean_network(monkeypatch: pytest.MonkeyPatch) -> None:
    log, results = go(monkeypatch, trials=2)
    pair, single = ("mqtt original", "zenoh original"), ("mqtt h264 opus",)
    turns = [(pair, "1024k"), (single, "1024k"), (single, "5%"), (pair, "5%")]  # the last one comes first
    expected = [sorted(f"{one}: {what}" for one in group) for group, name in turns for what in (name, "clean")]
    applied = iter(log)
    assert [sorted(islice(applied, len(group))) for group in expected] == expected
    assert list(applied) == ["hurry"] * 3
    assert results.complete, "although nothing arrived"
    assert {cell.params["trial"] for cell in results.cells} == {"1024k", "5%"}


def test_a_robot_that_fails_ends_the_run_and_costs_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    _, results = go(monkeypatch, trials=1)
    (note,) = results.notes
    assert note.startswith("The trials ended early: ")
    assert note.endswith(" said nothing for 30 s")
    assert not results.complete
    assert results.find("mqtt h264 opus", DRIVE, trial="1024k") is not None


def test_robots_that_fail_at_once_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PebbleError, match="mqtt original: the operator said nothing for 30 s"):
        go(monkeypatch, trials=0)
