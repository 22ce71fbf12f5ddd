"""A visitor's first ten minutes with the demo: fingers in Chromium, and a clock. The visitor never stops to think.

``pytest -s`` prints the clock at each step.
"""

from __future__ import annotations

import itertools
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import pytest
from playwright.sync_api import Browser

from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.program import trace_path
from tests.ext.page.browser import Tab, tab
from tests.kit.demo import START_S, Demo, demos, page_of, start, temporary

__all__ = ["demos", "temporary"]
pytest.importorskip("duckdb")  # it makes timelines
pytestmark = [pytest.mark.page, pytest.mark.timeout(600)]

GOOB = "pebble/robots/goob"
LONGEST_S = 480.0  # on a busy machine; an idle one takes a quarter of it
#: How far apart the ends of the map's trail are, in metres.
TRAIL = """async () => {
  const { recorderOf } = await import(`/static/${pebble.connection.version}/ui/parts/recorder.js`);
  const rows = recorderOf(pebble, pebble.route.ref).all.get("poses wheel-odometry")?.rows ?? [];
  return Math.max(0, ...rows.map(({ x, y }) => Math.hypot(x - rows[0].x, y - rows[0].y)));
}"""


class Visitor:
    """Presses what the page shows."""

    def __init__(self, opened: Tab) -> None:
        self.tab, self.page = opened, opened.page
        self._began = time.monotonic()

    @property
    def clock(self) -> float:
        return time.monotonic() - self._began

    def did(self, what: str) -> None:
        """Nothing has failed until here."""
        sys.stdout.write(f"{self.clock:6.1f} s  {what}\n")
        assert self.tab.complaints() == []

    def sees(self, condition: Callable[[], object] | str, within: float = 30.0) -> None:
        assert self.tab.until(condition, within), self.page.locator("body").inner_text()

    def state(self, metric: str) -> Any:
        return self.page.evaluate("([ref, metric]) => pebble.store.get(ref, metric)?.value", [GOOB, metric])

    def presses(self, name: str, within: float = 30.0) -> None:
        self.tab.test(name).click(timeout=1000 * within)

    def drives(self, until: Callable[[], bool], *keys: str) -> None:
        """Holds one key after another, again and again on a busy machine, until the drive has had its effect."""
        times = itertools.cycle(keys)

        def goes() -> bool:
            self.page.keyboard.down(key := next(times))
            has_gone = self.tab.until(until, 1.5)
            self.page.keyboard.up(key)
            return has_gone

        self.sees(goes, 90)


@pytest.fixture
def demo(demos: list[Demo], temporary: Path) -> Iterator[Demo]:
    """It has ended by Ctrl-C and left nothing, whatever its visitor did."""
    running = start(demos, temporary, "")
    yield running
    running.process.send_signal(signal.SIGINT)
    running.process.wait(START_S)
    assert running.leftovers() == []
    assert running.folders() == [], running.output


def test_a_visitor_sees_drives_stops_starts_a_script_and_takes_a_film_home(demo: Demo, browser: Browser) -> None:
    url = page_of(demo)
    with tab(browser, url, engineers=False, accept_downloads=True) as opened:
        visitor = Visitor(opened)
        visitor.sees("document.querySelectorAll('.fleet-card').length >= 4", START_S)
        visitor.did("all robots are there")
        visitor.sees("document.querySelector('.thumbnail img')", 15)
        visitor.did("what a camera sees is on the fleet")
        visitor.sees(lambda: f"the robots are yours: {url}" in demo.output, 120)
        visitor.did("they are the visitor's")

        opened.page.locator(".fleet-card", has_text="goob").first.click()
        visitor.sees(lambda: opened.test("video").is_visible())
        visitor.sees(lambda: visitor.state("wheel-odometry"), 120)
        visitor.did("Goob is open")
        visitor.presses("take")
        since_ns = time.monotonic_ns()
        trace = trace_path(demo.folders()[0] / "world", "goob")
        motors = lambda: [one.motors for one in read_trace(trace) if one.ns > since_ns and one.motors is not None]
        visitor.drives(lambda: any(map(any, motors())), "KeyS", "KeyW")
        visitor.did("it drives")

        opened.page.get_by_role("button", name="STOP: emergency stop of Goob").click()
        visitor.sees(lambda: visitor.state("web/estop")["latched"])
        visitor.did("it is stopped")
        visitor.presses("reset")
        opened.test("reset-hold").hover()
        opened.page.mouse.down()
        visitor.sees(lambda: not visitor.state("web/estop")["latched"])
        opened.page.mouse.up()
        visitor.did("it is reset")

        opened.test("script-apriltag-follow").click()
        visitor.sees(lambda: opened.test("start-script").is_enabled())
        visitor.presses("start-script")
        visitor.sees(lambda: "running" in opened.test("script-state").inner_text())
        visitor.did("a script runs")
        visitor.presses("end-script")
        visitor.sees(lambda: "No script runs" in opened.test("script-state").inner_text())

        opened.test("map").scroll_into_view_if_needed()
        visitor.sees(lambda: (visitor.state("autonomy-status") or {}).get("file") == "wheel-odometry", 60)
        opened.page.evaluate("document.activeElement.blur()")
        visitor.drives(lambda: opened.page.evaluate(TRAIL) > 0.1, "KeyS", "KeyD", "KeyW")
        opened.test("map").scroll_into_view_if_needed()
        visitor.did("the map has its trail")

        opened.page.get_by_role("link", name="Recordings").first.click()
        visitor.sees("window.pebble?.replay?.video.info", 60)
        visitor.did("its recording is open")
        visitor.presses("open-download")
        visitor.presses("download")
        with opened.page.expect_download(timeout=120_000) as download:
            visitor.presses("download-file", 120)
        with av.open(download.value.path()) as film:
            assert sum(1 for _ in film.decode(video=0)) > 10
        visitor.did("a film is downloaded")
        assert opened.page.evaluate("pebble.settings.begun.join()") == "drive,script,recordings"
        assert visitor.clock < LONGEST_S
