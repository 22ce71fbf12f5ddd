"""The report is one file that needs no other, names what the paper names, and lets no name of a robot do anything."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from pebble.extensions.recordings.traffic.analysis import analyse
from pebble.extensions.recordings.traffic.report import remarks, write_report
from pebble.extensions.recordings.traffic.results import AUDIO, Gap, Traffic
from pebble.extensions.recordings.traffic.sources import sources
from pebble.extensions.recordings.traffic.tables import tables, write_csv
from tests.ext.recordings.demo_robots import FRED
from tests.ext.recordings.synthetic import START_NS, Sent, demo_folder, write_recording

pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")

EVIL = "<img src=x onerror=alert(1)>"


def analysed(folder: Path, messages: list[Sent]) -> Traffic:
    write_recording(folder / "recordings" / "x.mcap", messages)
    return analyse(sources([folder / "recordings"], folder / "scratch"), folder / "scratch")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Traffic:
    """The demo's robots."""
    folder = tmp_path_factory.mktemp("demo")
    return analyse(sources([demo_folder(folder / "recordings")], folder / "scratch"), folder / "scratch")


@pytest.fixture(scope="module")
def written(recorded, tmp_path_factory) -> list[Path]:
    return write_report(recorded, tmp_path_factory.mktemp("report"), csv=True)


@pytest.fixture(scope="module")
def page(written) -> str:
    return written[0].read_text()


def test_nothing_is_loaded_or_run_and_every_drawing_has_a_name(page, recorded):
    assert re.findall(r"<(?:script|img|link|iframe|object|image)\b", page) == []
    links = re.findall(r'(?:href|src)="([^"]*)"', page)
    assert links
    assert all(link.startswith("#") for link in links)
    assert re.findall(r"https?://|url\((?!#)|@import", page) == []
    assert "default-src 'none'" in page
    drawings = re.findall(r"<svg\b[^>]*>", page)
    assert len(drawings) == 3 * len(recorded.robots)
    assert all('role="img"' in drawing and 'aria-label="' in drawing for drawing in drawings)


def test_gaps_and_losses_stand_out(recorded):
    recorded = Traffic(**{name: getattr(recorded, name) for name in recorded.__struct_fields__})
    recorded.gaps, recorded.dropped, recorded.missing = [Gap(START_NS, START_NS + 10**9, "lost")], 5, 7
    assert remarks(recorded)[0].startswith("Nothing was recorded once")
    assert "5 messages were not recorded" in remarks(recorded)[1]
    assert "7 were lost to damage" in remarks(recorded)[1]


def test_names_of_robots_do_nothing(tmp_path):
    robots = [f"pebble/robots/{name}" for name in (EVIL.replace("/", ""), "$x^2$ & 'y' \"z\"")]
    sent = [Sent(START_NS + at * 10**8, f"{robots[at % 2]}/outgoing/online", b'{"t":1}') for at in range(60)]
    found = analysed(tmp_path, sent)
    page = write_report(found, tmp_path)[0].read_text()
    assert EVIL not in page
    assert "&lt;img" in page


def test_csv_has_a_file_for_each_table(recorded, written):
    assert [path.suffix for path in written] == [".html", *[".csv"] * len(tables(recorded))]
    folder = written[0].parent
    (row,) = csv.DictReader((folder / "table-4-1-media-bandwidth.csv").open())
    (fred,) = (robot for robot in recorded.robots if robot.robot == row["robot"] == FRED)
    assert float(row["audio_median_kbps"]) == pytest.approx(fred.of(AUDIO).median_kbps, abs=0.05)
    outages = list(csv.DictReader((folder / "outages.csv").open()))
    assert len(outages) == sum(len(robot.outages) for robot in recorded.robots)


@pytest.mark.parametrize("name", ["=1+1", "\tx"])
def test_a_name_is_no_formula(recorded, tmp_path, name):
    table = tables(recorded)[1]
    path = write_csv(type(table)("x", "", [("robot", ""), ("number", "")], [[name, -1]]), tmp_path)
    assert path.read_bytes() == f"robot,number\r\n'{name},-1\r\n".encode()
