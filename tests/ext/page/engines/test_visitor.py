"""A visitor's first minutes with the demo: fingers in Firefox and Chromium, and a clock."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.program import trace_path
from tests.ext.page.engines.engines import Chromium, Engine, chromium_with_finger, firefox
from tests.ext.page.engines.test_engines import QUIET
from tests.ext.page.fingers import REACHED
from tests.kit.demo import START_S, Demo, demos, page_of, start, temporary
from tests.support import until

__all__ = ["demos", "temporary"]
pytest.importorskip("duckdb")  # it makes timelines
pytestmark = [pytest.mark.page, pytest.mark.timeout(1200)]

_TOUCH = {"dom.w3c_touch_events.enabled": 1}
_ERRORS = """void (globalThis.complaints = [],
  addEventListener("error", ({ message }) => message.startsWith("ResizeObserver loop") || complaints.push(message)),
  addEventListener("unhandledrejection", (event) => complaints.push(String(event.reason))))"""
#: What has moved by itself, where a browser tells, of what stops a robot or gives control over it.
_MOVES = """void (globalThis.moved = [],
  PerformanceObserver.supportedEntryTypes.includes("layout-shift") && new PerformanceObserver((list) => {
    const urgent = document.querySelectorAll(
      ".top .stop, .stops summary, .banner, [data-test^=reset], [data-test^=take], [data-test=ask]");
    const moves = ({ node }) => [...urgent].some((one) => node?.contains(one));
    for (const { hadRecentInput, sources } of list.getEntries())
      if (!hadRecentInput) moved.push(...sources.filter(moves).map(({ node }) => node.outerHTML.slice(0, 200)));
  }).observe({ type: "layout-shift", buffered: true }))"""
_HAS_CONTROL = "Boolean(document.querySelector('[data-test=release]'))"
_SHOWN = "document.querySelector('{}')?.getClientRects().length"
_FOLLOWS = "document.querySelector('[data-test=script-state]').innerText.includes('Follow a tag')"


class Visitor:
    """Presses with a finger what the page shows."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self._began = engine, time.monotonic()
        self.header: object = None

    def sees(self, expression: str, within: float = 60.0) -> None:
        assert self.engine.until(expression, within), self.engine.evaluate("document.body.innerText")

    def insists(self, selector: str, expression: str, hold_ms: int = 0) -> None:
        """Press what the page shows, again if it had no effect: a tap is no tap where a busy machine makes it long."""

        def works() -> bool:
            if self.engine.evaluate(f"Boolean(document.querySelector({selector!r}))"):
                self.engine.click(selector, hold_ms, "touch")
            return self.engine.until(expression, 10)

        assert until(works, 90), self.engine.evaluate("document.body.innerText")

    def takes_control(self) -> None:
        """Take control if it is not the visitor's, also again after a rest has ended it."""
        if not self.engine.evaluate(_HAS_CONTROL):
            self.insists("[data-test=take]", _HAS_CONTROL)

    def did(self, what: str) -> None:
        """Nothing has failed or moved by itself until here, and nothing covers STOP."""
        sys.stdout.write(f"{time.monotonic() - self._began:6.1f} s  {what}\n")
        header, covered = self.engine.evaluate(REACHED)
        assert covered == [], what
        assert self.header in (None, header), what
        self.header = header
        assert self.engine.evaluate("globalThis.complaints ?? []") == [], what
        assert self.engine.evaluate("moved.splice(0)") == [], what
        if isinstance(self.engine, Chromium):
            assert self.engine.tab.complaints() == [], what

    def arrives(self) -> None:
        """Another screen may have another header."""
        self.header = None


@contextmanager
def _shown(browser: str, size: tuple[int, int], folder: Path) -> Iterator[Engine]:
    if browser == "Chromium":
        with chromium_with_finger(*size) as engine:
            yield engine
    else:
        with firefox(folder, QUIET | _TOUCH) as engine:
            engine.resize(*size)
            yield engine


@pytest.mark.parametrize("browser", ["Firefox", "Chromium"])
@pytest.mark.parametrize("size", [(1440, 900), (390, 844)], ids=["desktop", "phone"])
def test_a_visitor_sees_drives_stops_and_starts_a_script(
    demos: list[Demo], temporary: Path, tmp_path: Path, browser: str, size: tuple[int, int]
) -> None:
    demo, phone = start(demos, temporary, ""), size[0] < 600
    with _shown(browser, size, tmp_path) as engine:
        visitor = Visitor(engine)
        engine.open(page_of(demo))
        engine.evaluate(_ERRORS)
        engine.evaluate(_MOVES)
        visitor.sees("document.querySelectorAll('.fleet-card').length >= 4", START_S)
        visitor.did("all robots are there")
        visitor.sees("document.querySelector('.thumbnail img')", 15)
        visitor.did("one of them shows a picture")
        assert until(lambda: "the robots are yours" in demo.output, 120)
        visitor.insists(".fleet-card [href$='/goob']", "pebble.route.ref.endsWith('/goob')")
        visitor.arrives()
        visitor.sees("pebble.video.info && document.querySelector('[data-test=take]')")
        visitor.did("Goob is open, with its picture")
        visitor.takes_control()
        visitor.did("it is the visitor's")
        since_ns, trace = time.monotonic_ns(), trace_path(demo.folders()[0] / "world", "goob")
        for _ in range(20):
            visitor.takes_control()
            engine.hold("w", 700)
            if any(any(seen.motors or ()) for seen in read_trace(trace) if seen.ns > since_ns):
                break
        else:
            pytest.fail("its motors did not run")
        visitor.did("it drives")
        stopped = "pebble.store.get(pebble.route.ref, 'web/estop')?.value.latched"
        visitor.insists("[data-test=stop-one]", stopped)
        visitor.did("it is stopped")
        visitor.insists("[data-test=reset]", "document.querySelector('[data-test=reset-hold]')")
        visitor.insists("[data-test=reset-hold]", f"!{stopped}", 2000)
        visitor.did("it is reset")
        if phone:
            visitor.insists("[data-test=tab-more]", _SHOWN.format("[data-test=script-apriltag-follow]"))
        start_button = "[data-test=start-script]:enabled"
        visitor.insists("[data-test=script-apriltag-follow]", f"document.querySelector('{start_button}')")
        visitor.insists(start_button, _FOLLOWS)
        visitor.did("a script runs")
        visitor.insists("[data-test=end-script]", f"!{_FOLLOWS}")
        visitor.did("it is ended")
        if phone:
            visitor.insists("[data-test=settings]", _SHOWN.format('[href*="/replay/"]'))
        visitor.insists("[href*='/replay/']", "pebble.replay")
        visitor.arrives()
        visitor.insists("[data-test=play]", "pebble.replay.video.info")
        visitor.did("its recording is open")
