"""Two result files: worse metrics are named, noise is not."""

import io
import random
import sys
from pathlib import Path

import pytest
from rich.console import Console

from pebble import cli
from pebble.bench.judging import ratios
from pebble.bench.judging.compare import CHANCE, Kind, certainty, compare, differences, run, summary
from pebble.bench.results import Cell, Results
from pebble.errors import PebbleError

CONDITIONS = [("640x480", 1), ("1920x1080", 3)]
VARIANTS = ("zenoh-shm", "zenoh-copy", "mqtt")


def results(
    seed: int, slower: str = "", factor: float = 1.0, rounds: int = 10, bench: str = "frames", each: int = 100
) -> Results:
    """A run as on a quiet machine; ``slower`` takes ``factor`` as long everywhere."""
    noise = random.Random(seed)
    cells = []
    for variant in VARIANTS:
        for size, readers in CONDITIONS:
            usual = 400 * (factor if variant == slower else 1.0)
            moods = [usual * noise.lognormvariate(0, 0.02) for _ in range(rounds)]
            samples = [[mood * noise.lognormvariate(0, 0.1) for _ in range(each)] for mood in moods]
            params = {"size": size, "readers": readers}
            cells.append(Cell(variant=variant, params=params, measure="frame", unit="us", rounds=samples))
    return Results(bench=bench, cells=cells, machine={"cpu": "one", "cores": 2}, options={"rounds": rounds})


def one(*rounds: list[float], unit: str = "us", measure: str = "frame") -> Results:
    return Results(bench="x", cells=[Cell(variant="mqtt", measure=measure, unit=unit, rounds=list(rounds))])


def kinds(a: Results, b: Results) -> list[Kind]:
    return [finding.kind for finding in compare(a, b)]


def report(tmp_path: Path, a: Results, b: Results, **options: object) -> tuple[int, str]:
    a.save(tmp_path / "a.json")
    b.save(tmp_path / "b.json")
    printed = io.StringIO()
    code = run(tmp_path / "a.json", tmp_path / "b.json", console=Console(file=printed, width=80), **options)  # type: ignore[arg-type]
    return code, printed.getvalue()


def test_a_planted_slowdown_is_found_and_named(tmp_path: Path) -> None:
    code, printed = report(tmp_path, results(1), results(2, "zenoh-copy", 1.2))
    assert code == 1
    shown = [line for line in printed.splitlines() if "us" in line]
    assert [line.split(",")[0].strip() for line in shown][:2] == ["zenoh-copy"] * 2
    assert all(line.rstrip().endswith("worse") for line in shown)
    assert "mqtt" not in printed


def test_the_same_twice_is_no_change(tmp_path: Path) -> None:
    code, printed = report(tmp_path, results(1), results(2))
    assert code == 0
    assert printed.startswith("12 metrics compared: 0 worse, 0 better, 12 without a difference beyond noise; 0 unknown")
    assert "99.92 %" in printed


def test_all_shows_what_did_not_change(tmp_path: Path) -> None:
    _, printed = report(tmp_path, results(1), results(2), everything=True)
    assert printed.count("no difference") == 12


def test_a_faster_run_is_better_and_exits_with_0(tmp_path: Path) -> None:
    code, printed = report(tmp_path, results(1, "mqtt", 1.5), results(2))
    assert code == 0
    assert "better" in printed


@pytest.mark.thorough
def test_noise_rarely_shows_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ratios, "RESAMPLES", 500)
    runs = [(results(2 * n, each=3), results(2 * n + 1, each=3)) for n in range(300)]
    false_alarms = sum(any(finding.changed for finding in compare(a, b, threshold=1.0)) for a, b in runs)
    assert false_alarms <= 6  # 3 are expected; with 5 % instead of 1 %, so few would occur in one of a hundred tests


def test_the_worst_comes_first() -> None:
    a, b = results(1), results(2, "mqtt", 1.3)
    for cell in b.cells[:1]:
        cell.rounds = [[9 * sample for sample in samples] for samples in cell.rounds]
    for cell in b.cells[2:3]:
        cell.rounds = [[sample / 3 for sample in samples] for samples in cell.rounds]
    found = compare(a, b)
    assert [finding.cell.variant for finding in found[:3]] == ["zenoh-shm", "zenoh-shm", "mqtt"]
    assert [finding.kind for finding in found] == sorted((f.kind for f in found), key=list(Kind).index)
    assert sum(finding.kind is Kind.BETTER for finding in found) == 2


def test_more_metrics_need_a_higher_confidence_level() -> None:
    assert certainty(1) == pytest.approx(1 - CHANCE)
    assert certainty(100) == pytest.approx(1 - CHANCE / 100)
    assert {finding.ratio.level for finding in compare(results(1), results(2))} == {certainty(12)}


def test_below_the_threshold_nothing_is_a_change() -> None:
    a, b = one(*[[100.0]] * 10), one(*[[104.0]] * 10)
    assert kinds(a, b) == kinds(b, a) == [Kind.EQUAL]
    assert [finding.kind for finding in compare(a, b, 1.03)] == [Kind.WORSE]


def test_what_is_in_one_file_only() -> None:
    a, b = results(1), results(2)
    del a.cells[:2], b.cells[4:]
    found = {finding.kind: finding.cell.variant for finding in compare(a, b) if finding.kind is not Kind.EQUAL}
    assert found == {Kind.ONLY_A: "mqtt", Kind.ONLY_B: "zenoh-shm"}


def test_missing_samples_count_as_worse(tmp_path: Path) -> None:
    silent = one([], [])
    assert kinds(one([1.0], [1.0]), silent) == [Kind.NO_SAMPLES]
    assert report(tmp_path, one([1.0], [1.0]), silent)[0] == 1
    assert kinds(silent, silent) == []
    assert kinds(silent, one([1.0], [1.0])) == [Kind.ONLY_B]


def test_few_rounds_are_not_judged() -> None:
    assert kinds(one(*[[1.0]] * 7), one(*[[5.0]] * 10)) == [Kind.UNKNOWN]
    assert kinds(one(*[[1.0]] * 8), one(*[[5.0]] * 8)) == [Kind.WORSE]
    assert kinds(one(*[[1.0]] * 7, []), one(*[[5.0]] * 8)) == [Kind.UNKNOWN]
    assert kinds(one(*[[0.0]] * 8), one(*[[5.0]] * 8)) == [Kind.UNKNOWN]
    assert "1 unknown: fewer than 8 rounds" in summary(compare(one([1.0]), one([5.0])))[0]


def test_p99_is_compared_where_rounds_have_hundreds_of_samples() -> None:
    enough, few = one(*[[1.0] * 100] * 8), one(*[[1.0] * 99] * 8)
    assert [finding.percent for finding in compare(enough, enough)] == [50, 99]
    assert [finding.percent for finding in compare(enough, few)] == [50]


def test_more_pictures_per_second_are_better_and_none_is_worst() -> None:
    fifteen, twenty, none = (one(*[[rate]] * 8, unit="1/s", measure="pictures") for rate in (15.0, 20.0, 0.0))
    assert kinds(fifteen, twenty) == [Kind.BETTER]
    assert kinds(twenty, fifteen) == [Kind.WORSE]
    assert kinds(fifteen, none) == [Kind.NO_SAMPLES]
    assert kinds(one([15.0], unit="1/s"), one([0.0], unit="1/s")) == [Kind.NO_SAMPLES]


def losing(*lost: int) -> Results:
    """Of 50 messages in each round."""
    run = one(*[[1.0] * (50 - count) for count in lost])
    run.cells[0].figures["sent"] = 50 * len(lost)
    return run


def test_more_that_is_lost_is_worse_and_a_burst_is_noise(tmp_path: Path) -> None:
    clean, lossy, burst = losing(*[0] * 10), losing(*[1, 2, 3, 2, 1, 2, 3, 1, 2, 3]), losing(*[0] * 9, 20)
    assert kinds(clean, clean) == [Kind.EQUAL]  # the median
    assert kinds(clean, lossy) == [Kind.WORSE, Kind.EQUAL]
    assert kinds(lossy, clean) == [Kind.BETTER, Kind.EQUAL]
    assert kinds(clean, burst) == [Kind.EQUAL, Kind.EQUAL]
    assert kinds(losing(0), losing(9)) == [Kind.UNKNOWN, Kind.UNKNOWN]
    code, printed = report(tmp_path, clean, lossy)
    assert code == 1
    assert "lost %" in printed


def test_bytes_of_encoders_are_the_same_every_time() -> None:
    assert kinds(one([100.0], unit="kB/s", measure="wire"), one([110.0], unit="kB/s", measure="wire")) == [Kind.WORSE]
    assert kinds(one([100.0], unit="kB/s", measure="wire"), one([101.0], unit="kB/s", measure="wire")) == [Kind.EQUAL]
    assert kinds(one([100.0], unit="kbit/s"), one([110.0], unit="kbit/s")) == [Kind.UNKNOWN]


def test_curves_over_time_are_not_compared() -> None:
    assert kinds(*[one([1.0, 2.0], [3.0, 4.0], measure="audio over time")] * 2) == []


def test_other_differences_are_listed(tmp_path: Path) -> None:
    a, b = results(1, each=1), results(2, rounds=9, each=1)
    b.machine, b.quick, b.pebble = {"cpu": "another", "cores": 2, "kernel": "6"}, True, "9.9"
    assert differences(a, b) == [
        "cpu: one in A, another in B",
        "rounds: 10 in A, 9 in B",
        f"pebble: {a.pebble} in A, 9.9 in B",
        "quick: False in A, True in B",
        "kernel: None in A, 6 in B",
    ]
    assert "not the same: cpu" in report(tmp_path, a, b)[1]


def test_only_files_of_the_same_bench_are_compared(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match=r"a\.json is of bench frames, .*b\.json of bench control"):
        report(tmp_path, results(1), results(2, bench="control"))


def test_the_command_ends_with_1_where_something_got_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(tmp_path, results(1), results(2, "mqtt", 1.2))
    a, b = str(tmp_path / "a.json"), str(tmp_path / "b.json")
    for arguments, code in (([a, b], 1), ([b, a], 0), ([a, a, "--all"], 0)):
        monkeypatch.setattr(sys, "argv", ["pebble", "bench", "compare", *arguments])
        assert cli.main() == code
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["pebble", "bench", "compare", a, str(tmp_path / "no.json")])
    assert cli.main() == 1
    assert "no.json" in capsys.readouterr().err
