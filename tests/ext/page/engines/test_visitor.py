"""A visitor's first minutes with the demo in Firefox: fingers, and a clock."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.program import trace_path
from tests.ext.page.engines.engines import Firefox, firefox
from tests.ext.page.engines.test_engines import QUIET
from tests.kit.demo import START_S, Demo, demos, page_of, start, temporary
from tests.support import until

__all__ = ["demos", "temporary"]
pytest.importorskip("duckdb")  # it makes timelines
pytestmark = [pytest.mark.page, pytest.mark.timeout(600)]

_TOUCH = {"dom.w3c_touch_events.enabled": 1}
_ERRORS = """void (globalThis.complaints = [],
  addEventListener("error", ({ message }) => message.startsWith("ResizeObserver loop") || complaints.push(message)),
  addEventListener("unhandledrejection", (event) => complaints.push(String(event.reason))))"""
#: Where the parts of the header lie, and whether a press on STOP reaches it.
_HEADER = """[...document.querySelectorAll(".top .stop")].map((stop) => {
  const { x, y, width, height } = stop.getBoundingClientRect();
  return [Math.round(x), Math.round(y), stop.contains(document.elementFromPoint(x + width / 2, y + height / 2))];
})"""


class Visitor:
    """Presses with a finger what the page shows."""

    def __init__(self, engine: Firefox) -> None:
        self.engine, self._began = engine, time.monotonic()
        self.header: object = None

    def sees(self, expression: str, within: float = 60.0) -> None:
        assert self.engine.until(expression, within), self.engine.evaluate("document.body.innerText")

    def presses(self, selector: str, hold_ms: int = 0) -> None:
        self.engine.click(selector, hold_ms, "touch")

    def did(self, what: str) -> None:
        """Nothing has failed or moved by itself until here, and nothing covers STOP."""
        sys.stdout.write(f"{time.monotonic() - self._began:6.1f} s  {what}\n")
        header = self.engine.evaluate(_HEADER)
        assert all(reached for _, _, reached in header), what
        assert self.header in (None, header), what
        self.header = header
        assert self.engine.evaluate("globalThis.complaints ?? []") == [], what

    def arrives(self) -> None:
        """Another screen may have another header."""
        self.header = None


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)], ids=["desktop", "phone"])
def test_a_visitor_sees_drives_stops_and_starts_a_script(
    demos: list[Demo], temporary: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    demo = start(demos, temporary, "")
    with firefox(tmp_path, QUIET | _TOUCH) as engine:
        engine.resize(*size)
        visitor = Visitor(engine)
        engine.open(page_of(demo))
        engine.evaluate(_ERRORS)
        visitor.sees("document.querySelectorAll('.fleet-card').length >= 4", START_S)
        visitor.did("all robots are there")
        visitor.sees("document.querySelector('.thumbnail img')", 15)
        visitor.did("one of them shows a picture")
        assert until(lambda: "the robots are yours" in demo.output, 120)
        visitor.presses(".fleet-card [href$='/goob']")
        visitor.arrives()
        visitor.sees("pebble.video.info && document.querySelector('[data-test=take]')")
        visitor.did("Goob is open, with its picture")
        visitor.presses("[data-test=take]")
        visitor.sees("document.querySelector('[data-test=release]')")
        visitor.did("it is the visitor's")
        since_ns, trace = time.monotonic_ns(), trace_path(demo.folders()[0] / "world", "goob")
        for _ in range(20):
            engine.hold("w", 700)
            if any(any(seen.motors or ()) for seen in read_trace(trace) if seen.ns > since_ns):
                break
        else:
            pytest.fail("its motors did not run")
        visitor.did("it drives")
        visitor.presses("[data-test=stop-one]")
        stopped = "pebble.store.get(pebble.route.ref, 'web/estop')?.value.latched"
        visitor.sees(stopped)
        visitor.did("it is stopped")
        visitor.presses("[data-test=reset]")
        visitor.presses("[data-test=reset-hold]", 2000)
        visitor.sees(f"!{stopped}")
        visitor.did("it is reset")
        if size[0] < 600:
            visitor.presses("[data-test=tab-more]")
        visitor.presses("[data-test=script-apriltag-follow]")
        visitor.presses("[data-test=start-script]:enabled")
        visitor.sees("document.querySelector('[data-test=script-state]').innerText.includes('runs')")
        visitor.did("a script runs")
        visitor.presses("[data-test=end-script]")
        visitor.sees("document.querySelector('[data-test=script-state]').innerText.includes('No script runs')")
        visitor.presses("[href*='/replay/']")
        visitor.arrives()
        visitor.sees("pebble.replay?.video.info")
        visitor.did("its recording is open")
