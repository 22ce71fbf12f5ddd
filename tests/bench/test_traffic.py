"""The paper's section 4.1 with simulated robots: what the report shows of an analysis, and a real recording."""

from __future__ import annotations

import importlib.util
import io
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import traffic as comparison
from pebble.bench.comparison import chosen
from pebble.bench.engine import run
from pebble.bench.pictures import pictures
from pebble.bench.results import load
from pebble.bench.traffic import TABLE_4_1, TRAFFIC, assessment, cells_of, robots_of, tables
from pebble.errors import PebbleError
from pebble.recordings.traffic.analysis import analyse
from pebble.recordings.traffic.results import ALL, AUDIO, VIDEO, Bandwidth, Traffic
from pebble.recordings.traffic.sources import sources
from tests.bench import synthetic
from tests.recordings.demo_robots import DRIVE, FRED, MEDIA, messages


def printed(traffic: Traffic) -> str:
    console = Console(record=True, width=120, file=io.StringIO())
    for table in tables(cells_of(traffic)):
        console.print(table)
    return console.export_text()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Traffic:
    """The analysis of the demo's robots in tests/data."""
    pytest.importorskip("duckdb")
    scratch = tmp_path_factory.mktemp("scratch")
    found = sources([DRIVE, MEDIA], scratch)
    return analyse(found, scratch)


def test_table_4_1_stands_beside_the_paper_s(recorded: Traffic) -> None:
    """The rates from bytes that are summed here, second by second."""
    lines = [line.split() for line in printed(recorded).splitlines()]
    assert ["fred", "paper", *(f"{value:.2f}" for value in TABLE_4_1["fred"])] in lines
    seconds: dict[int, int] = {}
    for message in messages(MEDIA):
        if message.channel.topic == f"{FRED}/outgoing/audio":
            second = message.log_ns // 10**9
            seconds[second] = seconds.get(second, 0) + len(message.payload)
    middle = sorted(seconds.values())
    median = (middle[(len(middle) - 1) // 2] + middle[len(middle) // 2]) / 2 * 8 / 1000
    here = lines[lines.index(["fred", "paper", *(f"{value:.2f}" for value in TABLE_4_1["fred"])]) + 1]
    assert here[0] == "here"
    assert float(here[3]) == pytest.approx(median, abs=0.006)


def test_heartbeats_have_a_line_for_each_robot(recorded: Traffic) -> None:
    lines = [line.split() for line in printed(recorded).splitlines()]
    robots = [(robot.robot.rpartition("/")[2], robot.latency) for robot in recorded.robots]
    shown = [(name, str(one.count), f"{one.median_ms:.1f}") for name, one in robots if one is not None]
    assert shown
    assert set(shown) <= {(line[0], line[1], line[-2]) for line in lines if len(line) > 5}


def test_sentences_name_what_differs(recorded: Traffic) -> None:
    found = [str(one) for one in assessment(cells_of(recorded))]
    assert any("heartbeats" in one.lower() and "20 to 40 ms" in one for one in found)
    assert any(one.startswith("Video differs") for one in found)


@pytest.mark.parametrize(
    ("seconds", "kbps", "expected"), [(20, 266.0, "met"), (20, 260.0, "missed"), (19, 266.0, "not judged")]
)
def test_the_bandwidth_of_sound_is_judged_over_many_seconds(seconds: int, kbps: float, expected: str) -> None:
    traffic = synthetic.analysed()
    for robot in traffic.robots:
        robot.bandwidth = [Bandwidth(AUDIO, ALL, seconds, kbps, kbps, 50 * seconds, 664 * 50 * seconds)]
    assert f"within 1 %: {expected} (goob {kbps:.1f} kbit/s" in str(next(iter(assessment(cells_of(traffic)))))


def test_the_whole_analysis_is_in_the_results(recorded: Traffic, tmp_path: Path) -> None:
    results = synthetic.traffic()
    results.cells = cells_of(recorded)
    results.save(tmp_path / "traffic.json")
    robots = robots_of(load(tmp_path / "traffic.json").cells)
    assert robots == {robot.robot.rpartition("/")[2]: robot for robot in recorded.robots}


def test_only_figures_of_robots_that_were_analysed_are_drawn() -> None:
    results = synthetic.traffic()
    (picture,) = pictures(results)
    titles = [axes.get_title(loc="left") for axes in picture.make().axes]
    assert [title.split(":")[0] for title in titles] == [f"Figure 4.{number}" for number in range(1, 7)]
    results.cells = [cell for cell in results.cells if cell.variant == "goob"]
    (picture,) = pictures(results)
    assert [axes.get_title(loc="left").split(",")[0] for axes in picture.make().axes] == [
        "Figure 4.1: goob",
        "Figure 4.2: goob",
    ]


def test_without_duckdb_it_is_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(comparison, "find_spec", lambda name: None if name == "duckdb" else found(name))
    with pytest.raises(PebbleError, match=r'left out: .* needs DuckDB: pip install "pebble-robot\[archive\]"'):
        run(TRAFFIC.run_of(quick=True, output=tmp_path))


@pytest.mark.alone
@pytest.mark.thorough
def test_the_robots_are_recorded_at_a_broker(tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    short = TRAFFIC.run_of(idle_s=8, session_s=6, quick=True, output=tmp_path, console=Console(quiet=True))
    assert run(short) == 0
    results = load(tmp_path / "traffic.json")
    robots = robots_of(results.cells)
    assert set(robots) == {"goob", "fred", "minilamp", "benjr"}
    for name in ("goob", "fred"):
        assert robots[name].of(VIDEO) is not None
        found = robots[name].of(AUDIO)
        assert found is not None
        assert found.messages > 100
        assert found.bytes == 664 * found.messages, "PCM of one channel"
    assert all(robot.sessions and robot.idle_s for robot in robots.values())
    assert (tmp_path / "traffic-figures.png").exists()
    assert chosen(["traffic"])[0].name == results.bench
