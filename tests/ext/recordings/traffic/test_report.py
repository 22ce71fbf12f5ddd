"""The report is one file that needs no other, names what the paper names, and lets no name of a robot do anything."""

from __future__ import annotations

import csv
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.recordings.traffic.analysis import analyse
from pebble.extensions.recordings.traffic.report import remarks, write_report
from pebble.extensions.recordings.traffic.results import Gap, Traffic
from pebble.extensions.recordings.traffic.sources import sources
from pebble.extensions.recordings.traffic.tables import tables, write_csv
from tests.ext.recordings.synthetic import FLEET, START_NS, Robot, Sent, traffic, write_recording

pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")

EVIL = "<img src=x onerror=alert(1)>"
FIGURES = re.compile(r"<figcaption><b>(Figures? [^:]*):")


def analysed(folder: Path, messages: list[Sent]) -> Traffic:
    write_recording(folder / "recordings" / "x.mcap", messages)
    return analyse(sources([folder / "recordings"], folder / "scratch"), folder / "scratch")


@pytest.fixture(scope="module")
def minute(tmp_path_factory) -> Traffic:
    return analysed(tmp_path_factory.mktemp("minute"), traffic())


@pytest.fixture(scope="module")
def written(minute, tmp_path_factory) -> list[Path]:
    return write_report(minute, tmp_path_factory.mktemp("report"), csv=True)


@pytest.fixture(scope="module")
def page(written) -> str:
    return written[0].read_text()


@pytest.fixture(scope="module")
def lamp(tmp_path_factory) -> Traffic:
    """A report of one component without heartbeats, which has few drawings."""
    sent = [Sent(START_NS, "pebble/infrastructure/mast/outgoing/charging-level", b"{}")]
    return analysed(tmp_path_factory.mktemp("lamp"), sent)


class Tags(HTMLParser):
    """Which elements and attributes a page has, and whether each is closed."""

    VOID = frozenset({"meta", "br", "path", "use", "rect", "circle"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_nothing_is_loaded_or_run(page):
    tags = Tags(page).found
    assert {tag for tag, _ in tags} & {"script", "img", "link", "iframe", "object", "image"} == set()
    links = [value for _, attributes in tags for name, value in attributes.items() if name.endswith(("href", "src"))]
    assert links
    assert all(link.startswith("#") for link in links)
    assert re.findall(r"https?://|url\((?!#)|@import", page) == []
    assert "default-src 'none'" in page


def test_figures_have_the_numbers_of_the_paper(page):
    linux, mcu = ["Figure 4.1", "Figure 4.2", "Figure 4.3"], ["Figure 4.4", "Figures 4.5 and 4.6", "Figure 4.3"]
    assert FIGURES.findall(page) == [*mcu, *linux, *linux, *mcu]  # benjr, fred, goob, minilamp
    assert "Table 4.1: bandwidth of media" in page


def test_every_drawing_has_a_name_for_those_who_cannot_see_it(page):
    drawings = [attributes for tag, attributes in Tags(page).found if tag == "svg"]
    assert len(drawings) == 3 * len(FLEET)
    assert all(drawing["role"] == "img" and drawing["aria-label"] for drawing in drawings)
    assert "<text" in page  # and not the shapes of letters


def test_gaps_and_losses_stand_out(minute):
    minute = Traffic(**{name: getattr(minute, name) for name in minute.__struct_fields__})
    minute.gaps, minute.dropped, minute.missing = [Gap(START_NS, START_NS + 10**9, "lost")], 5, 7
    assert remarks(minute)[0].startswith("Nothing was recorded once")
    assert "5 messages were not recorded" in remarks(minute)[1]
    assert "7 were lost to damage" in remarks(minute)[1]


def test_names_of_robots_do_nothing(tmp_path):
    robots = [Robot(EVIL.replace("/", ""), session=(0.0, 2.0)), Robot("$x^2$ & 'y' \"z\"")]
    found = analysed(tmp_path, traffic(robots, seconds=3.0))
    page = write_report(found, tmp_path)[0].read_text()
    assert EVIL not in page
    assert "&lt;img" in page
    assert Tags(page).open == []


def test_without_heartbeats_and_outages(lamp, tmp_path):
    page = write_report(lamp, tmp_path)[0].read_text()
    assert FIGURES.findall(page) == []
    assert "a component without heartbeats" in page


def test_csv_has_a_file_for_each_table(minute, written):
    assert [path.suffix for path in written] == [".html", *[".csv"] * len(tables(minute))]
    folder = written[0].parent
    rows = list(csv.DictReader((folder / "table-4-1-media-bandwidth.csv").open()))
    assert [row["robot"] for row in rows] == ["pebble/robots/fred", "pebble/robots/goob"]
    assert float(rows[0]["audio_median_kbps"]) == 265.6
    assert len(list(csv.DictReader((folder / "outages.csv").open()))) == 5


def test_without_csv_there_is_only_the_page(lamp, tmp_path):
    assert write_report(lamp, tmp_path) == list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@x", "\tx"])
def test_a_name_is_no_formula(minute, tmp_path, name):
    table = tables(minute)[1]
    path = write_csv(type(table)("x", "", [("robot", ""), ("number", "")], [[name, -1]]), tmp_path)
    assert path.read_bytes() == f"robot,number\r\n'{name},-1\r\n".encode()


def test_a_folder_that_cannot_be_written(minute, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(PebbleError, match="file"):
        write_report(minute, tmp_path / "file")
