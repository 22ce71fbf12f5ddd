"""Rounds are the observations, and failed ones count for nobody; a quick run of each comparison leaves nothing."""

from __future__ import annotations

import io
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import rounds
from pebble.extensions.lab.bench.impair.network import why_no_namespaces
from pebble.extensions.lab.bench.report import SECTIONS, Section
from pebble.extensions.lab.bench.results import Cell, Results, load, percentile, round_cell
from pebble.extensions.lab.bench.rounds import LEAST_ROUNDS, Progress, add_round, measure_rounds, paired
from pebble.extensions.lab.rig.processes import children
from tests.support import ROOT, WAIT_S, gone, until

Rounds = list[list[float]]
RUNS = 300


@pytest.fixture
def _fewer_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """A number of resamplings for hundreds of intervals within a second or two."""
    monkeypatch.setattr(rounds, "RESAMPLES", 1000)


def make(random: np.random.Generator, count: int, *, factor: float = 1.0, mood: float = 0.05) -> Rounds:
    """The samples look as measured ones do: each round has an offset of its own, and a long tail."""
    moods = factor * np.exp(random.normal(0, mood, count))
    return [(100 * one * np.exp(random.normal(0, 0.1, 25))).tolist() for one in moods]


@pytest.mark.usefixtures("_fewer_resamples")
def test_no_difference_is_not_called_one() -> None:
    random, count = np.random.default_rng(LEAST_ROUNDS), LEAST_ROUNDS
    intervals = [paired(make(random, count), make(random, count)) for _ in range(RUNS)]
    equal = sum(interval.low <= 1 <= interval.high for interval in intervals)
    assert equal >= 0.975 * RUNS  # the level is 99 %; 300 runs cannot distinguish it from 98 %


@pytest.mark.usefixtures("_fewer_resamples")
def test_a_planted_fifth_is_found() -> None:
    random = np.random.default_rng(7)
    seen = sum(paired(make(random, 12, factor=1.2, mood=0.04), make(random, 12, mood=0.04)).low > 1 for _ in range(100))
    assert seen >= 95


def test_what_never_arrived_is_infinitely_late() -> None:
    mostly, never = [[1.0, 1.0, math.inf]] * 10, [[1.0, math.inf, math.inf]] * 10
    assert paired(mostly, [[2.0]] * 10).ratio == pytest.approx(0.5)
    assert str(paired(never, [[2.0]] * 10)) == "∞ (∞ to ∞)"
    assert str(paired([[2.0]] * 10, never)) == "0 (0 to 0)"
    assert math.isnan(paired(never, never).ratio)
    assert paired([*never[:1], *mostly[:9]], [*never[:2], *mostly[:8]]).rounds == 9


@pytest.mark.parametrize(
    ("figures", "percent", "expected"),
    [([1.0, 2.0], 50, 1.0), (list(range(1, 101)), 99, 99), ([], 50, math.nan)],
)
def test_a_percentile_is_a_figure_that_was_measured(figures: list[float], percent: float, expected: float) -> None:
    assert percentile(figures, percent) == pytest.approx(expected, nan_ok=True)


def measured(outcomes: str) -> Results:
    """One round for each letter; ``x`` fails after its first variant."""
    results = Results(bench="wake-up")

    def measure(number: int, _progress: Progress) -> Iterator[Cell]:
        yield round_cell("pipe", "way", "us", [float(number)])
        if outcomes[number] == "x":
            raise PebbleError("the robot is not up\nits last [words]")
        yield round_cell("socket", "way", "us", [] if outcomes[number] == "-" else [1.0])

    measure_rounds(results, len(outcomes), measure, Console(file=io.StringIO()))
    return results


@pytest.mark.parametrize(
    ("outcomes", "complete"),
    [(10 * ".", True), ("..x......x", True), ("x.", True), (".x.x.x....", False), ("x.......", False), ("--", False)],
)
def test_a_round_that_fails_counts_for_no_variant(outcomes: str, complete: bool) -> None:
    results = measured(outcomes)
    assert [len(cell.rounds) for cell in results.cells] == [outcomes.count(".") + outcomes.count("-")] * 2
    assert results.complete is complete


def test_two_failures_at_the_start_end_the_run() -> None:
    with pytest.raises(PebbleError, match="the robot is not up"):
        measured("xx.")


def test_turns_of_a_round_are_one_and_counts_add_up() -> None:
    results = Results(bench="x")
    for cpu in (2.0, 4.0):
        add_round(results, [round_cell("a", "way", "us", [cpu], {"n": 1}, sent=2, cpu=cpu + turn) for turn in (0, 1)])
    (cell,) = results.cells
    assert cell.rounds == [[2.0, 2.0], [4.0, 4.0]]
    assert cell.figures == {"sent": [4, 4], "cpu": [2.5, 4.5]}
    assert (cell.lost, cell.middle("cpu"), cell.total("sent")) == (4, 3.5, 8)


# -- real processes


def command(name: str, *options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", name, "--quick", *options]


@pytest.fixture
def temporary() -> Iterator[Path]:
    """The folder for temporary files of the bench; short, because of Unix sockets: it would take another one."""
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        yield Path(folder)


@pytest.mark.alone
@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_a_quick_run_leaves_results_and_nothing_else(section: Section, temporary: Path, tmp_path: Path) -> None:
    if section.needs_root and (obstacle := why_no_namespaces()):
        pytest.skip(f"no namespaces: {obstacle}")
    if section.name == "traffic" and find_spec("duckdb") is None:
        pytest.skip("needs DuckDB")
    ended = subprocess.run(
        command(section.name, "--output", str(tmp_path)),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, check=False,
        timeout=300,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(tmp_path / f"{section.name}.json")
    assert results.complete
    assert results.quick
    assert results.cells
    assert all(sample >= 0 for cell in results.cells for sample in cell.samples)
    assert list(temporary.iterdir()) == []


def segments(pid: int) -> set[Path]:
    """The shared memory it uses."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if line.endswith(".zenoh")}


def test_ctrl_c_leaves_nothing(temporary: Path) -> None:
    bench = subprocess.Popen(
        command("frames", "--output", str(temporary / "results"), "--seconds", "30", "--variants", "zenoh-shm"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 2)
        started = children(bench.pid)
        assert until(lambda: all(map(segments, started)))
        shared = set().union(*map(segments, started))
        time.sleep(1)  # files younger than a second are not swept
        bench.send_signal(signal.SIGINT)
        assert bench.wait(WAIT_S) == 130
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: all(map(gone, started)))
    assert not any(segment.exists() for segment in shared)
    assert list(temporary.iterdir()) == [temporary / "results"]
