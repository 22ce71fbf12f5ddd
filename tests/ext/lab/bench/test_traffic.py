"""The paper's section 4.1 with simulated robots: what the report shows of an analysis, and a real recording."""

from __future__ import annotations

import importlib.util
import io
import shutil
from pathlib import Path

import pytest
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import traffic as comparison
from pebble.extensions.lab.bench.show import finish
from pebble.extensions.lab.bench.traffic import QUICK, TABLE_4_1, Analysed, Settings, heartbeat_table, media_table, run
from pebble.extensions.recordings.traffic.analysis import analyse
from pebble.extensions.recordings.traffic.results import AUDIO, IDLE, TOTAL, VIDEO
from pebble.extensions.recordings.traffic.sources import sources
from tests.ext.recordings.demo_robots import DRIVE, FRED, MEDIA, messages


def printed(robots: Analysed) -> list[list[str]]:
    console = Console(record=True, width=120, file=io.StringIO())
    console.print(media_table(robots), heartbeat_table(robots))
    return [line.split() for line in console.export_text().splitlines()]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Analysed:
    """The analysis of the demo's robots in tests/data."""
    pytest.importorskip("duckdb")
    scratch = tmp_path_factory.mktemp("scratch")
    found = sources([Path(shutil.copy2(path, scratch)) for path in (DRIVE, MEDIA)], scratch)
    return {robot.robot.rpartition("/")[2]: robot for robot in analyse(found, scratch).robots}


def test_table_4_1_stands_beside_the_paper_s(recorded: Analysed) -> None:
    """The rates from bytes that are summed here, second by second."""
    lines, paper = printed(recorded), ["fred", "paper", *(f"{value:.2f}" for value in TABLE_4_1["fred"])]
    seconds: dict[int, int] = {}
    for message in messages(MEDIA):
        if message.channel.topic == f"{FRED}/outgoing/audio":
            second = message.log_ns // 10**9
            seconds[second] = seconds.get(second, 0) + len(message.payload)
    middle = sorted(seconds.values())
    median = (middle[(len(middle) - 1) // 2] + middle[len(middle) // 2]) / 2 * 8 / 1000
    here = lines[lines.index(paper) + 1]
    assert here[0] == "here"
    assert float(here[3]) == pytest.approx(median, abs=0.006)


def test_heartbeats_have_a_line_for_each_robot(recorded: Analysed) -> None:
    robots = [(name, robot.latency) for name, robot in recorded.items()]
    shown = [(name, str(one.count), f"{one.median_ms:.1f}") for name, one in robots if one is not None]
    assert shown
    assert set(shown) <= {(line[0], line[1], line[-2]) for line in printed(recorded) if len(line) > 5}


def test_without_duckdb_it_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(comparison, "find_spec", lambda name: None if name == "duckdb" else found(name))
    with pytest.raises(PebbleError, match=r'left out: .* needs DuckDB: pip install "pebble-robot\[archive\]"'):
        run(QUICK, Console(quiet=True))


@pytest.mark.alone
@pytest.mark.thorough
def test_the_robots_are_recorded_at_a_broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("duckdb")
    robots: dict[str, Analysed] = {}
    measure = comparison.analysed
    monkeypatch.setattr(comparison, "analysed", lambda settings: robots.setdefault("all", measure(settings)))
    shown = run(Settings(idle_s=8, session_s=6), Console(quiet=True))
    assert finish(shown, tmp_path, Console(quiet=True)) == 0
    assert set(robots["all"]) == {"goob", "fred", "minilamp", "benjr"}
    for name in ("goob", "fred"):
        assert robots["all"][name].of(VIDEO) is not None
        sound = robots["all"][name].of(AUDIO)
        assert sound is not None
        assert sound.messages > 100
        assert sound.bytes == 664 * sound.messages, "PCM of one channel"
    assert all(robot.sessions and robot.of(TOTAL, IDLE) for robot in robots["all"].values())
    assert any("20 to 40 ms" in note for note in shown.results.notes)
    assert (tmp_path / "traffic-figures.png").exists()
