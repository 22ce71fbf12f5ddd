"""The course of the trials, with robots that only say what they are told to."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest
from rich.console import Console

from pebble.bench.results import load
from pebble.errors import PebbleError
from pebble.impair import run as module
from pebble.impair.conditions import Condition
from pebble.impair.link import Carried
from pebble.impair.messages import Order, Record, Said, Settle, Window
from pebble.impair.plan import Plan, Subject
from pebble.impair.run import run

S = 1_000_000_000
NOTHING = Record(
    commands=[],
    beats=[],
    pictures=[],
    sounds=[],
    alone=Window(0, S),
    video=Window(S, 2 * S),
    audio=Window(2 * S, 3 * S),
    payloads=0,
)
TRIAL = [Said(phase=phase) for name in ("alone", "video", "audio") for phase in (name, "")] + [Said(record=NOTHING)]


class QuietLink:
    kind = "proxy"

    def __init__(self, log: list[str], name: str) -> None:
        self._log, self._name = log, name

    def apply(self, condition: Condition) -> None:
        self._log.append(f"{self._name}: {condition.name}")

    def carried(self) -> Carried:
        return Carried()


class Puppet:
    """Goes through ``trials`` trials, then falls silent."""

    def __init__(self, subject: Subject, log: list[str], trials: int) -> None:
        self.subject, self.link = subject, QuietLink(log, subject.name)
        said = [Said(ready=True), *(one for _ in range(trials) for one in (Said(ready=True), *TRIAL))]
        self._says: Iterator[Said] = iter(said)

    def tell(self, order: Order | Settle) -> None: ...

    def hear(self, timeout: float) -> Said:
        said = next(self._says, None)
        if said is None:
            raise PebbleError(f"{self.subject.name} said nothing for {timeout:.0f} s")
        return said

    def entries(self, _since_ns: int) -> list[object]:
        return []


class Stage:
    """Stands for pebble.impair.robots.Field."""

    def __init__(self, log: list[str], trials: int) -> None:
        self._log, self._trials = log, trials
        self.robots: list[Puppet] = []

    def __call__(self, subjects: Sequence[Subject], _kind: str) -> Self:
        self.robots = [Puppet(subject, self._log, self._trials) for subject in subjects]
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None: ...

    def hurry(self) -> None:
        self._log.append("hurry")


PLAN = Plan(trials=["1024k", "5%"], subjects=["mqtt original", "zenoh original", "mqtt h264 opus"])


def go(monkeypatch: pytest.MonkeyPatch, folder: Path, trials: int, link: str = "proxy") -> tuple[list[str], str]:
    log: list[str] = []
    said = io.StringIO()
    monkeypatch.setattr(module, "Field", Stage(log, trials))
    monkeypatch.setattr("pebble.bench.output.find_spec", lambda _name: None)  # no plots
    plan = Plan(trials=PLAN.trials, subjects=PLAN.subjects, link=link, output=folder)
    try:
        run(plan, Console(file=said, width=120))
    except PebbleError as error:
        log.append(str(error))
    return log, said.getvalue()


def test_each_group_has_each_condition_and_then_a_good_link(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, said = go(monkeypatch, tmp_path, trials=2)
    pair, single = ("mqtt original", "zenoh original"), ("mqtt h264 opus",)
    turns = [(pair, "1024k"), (single, "1024k"), (single, "5%"), (pair, "5%")]  # who came last comes first
    expected = [sorted(f"{one}: {what}" for one in group) for group, name in turns for what in (name, "clean")]
    applied = iter(log)
    assert [sorted(islice(applied, len(group))) for group in expected] == expected
    assert list(applied) == ["hurry"]
    assert "loss modelled" in said


def test_the_file_says_under_which_conditions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    go(monkeypatch, tmp_path, trials=2)
    results = load(tmp_path / "impair.json")
    assert (results.bench, results.options["link"], results.options["window_s"]) == ("impair", "proxy", 8.0)
    marks = [mark.partition("@")[0] for mark in str(results.options["marks"]).split(";")]
    assert marks == ["1024k", "5%"]
    assert results.command[:4] == ["pebble", "impair", "--link", "proxy"]
    assert results.options["why_proxy"] is None


def test_a_proxy_that_nobody_asked_for_is_explained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pebble.impair.link.why_no_namespaces", lambda: "not permitted")
    _, said = go(monkeypatch, tmp_path, trials=2, link="auto")
    assert "A proxy stands in for the link: not permitted" in said
    results = load(tmp_path / "impair.json")
    assert (results.options["link"], results.options["why_proxy"]) == ("proxy", "not permitted")
    assert results.command[:4] == ["pebble", "impair", "--link", "proxy"]


def test_a_robot_that_fails_ends_the_run_and_costs_no_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, _ = go(monkeypatch, tmp_path, trials=1)
    assert log[-1].startswith("the trials ended early: ")
    assert log[-1].endswith(" said nothing for 30 s")
    results = load(tmp_path / "impair.json")
    assert results.find("mqtt h264 opus", trial="1024k") is not None
    assert results.verdict[0] == log[-1].replace("the trials", "The trials")


def test_robots_that_fail_at_once_leave_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, said = go(monkeypatch, tmp_path, trials=0)
    assert log[0] == "hurry"
    assert log[1].endswith("original said nothing for 30 s")
    assert "trial" not in said
    assert not (tmp_path / "impair.json").exists()
