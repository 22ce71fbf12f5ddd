"""A visitor's first minutes with the demo: a finger in Firefox."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.program import trace_path
from tests.ext.page.engines.engines import Engine, firefox
from tests.ext.page.fingers import REACHED
from tests.kit.demo import START_S, Demo, demos, page_of, start, temporary
from tests.support import until

__all__ = ["demos", "temporary"]
pytest.importorskip("duckdb")  # it makes timelines
pytestmark = [pytest.mark.page, pytest.mark.timeout(1200)]

_ERRORS = """void (globalThis.complaints = [],
  addEventListener("error", ({ message }) => message.startsWith("ResizeObserver loop") || complaints.push(message)),
  addEventListener("unhandledrejection", (event) => complaints.push(String(event.reason))))"""
_HAS_CONTROL = "Boolean(document.querySelector('[data-test=release]'))"
_STOPPED = "pebble.store.get(pebble.route.ref, 'web/estop')?.value.latched"
_SHOWN = "document.querySelector('{}')?.getClientRects().length"
_FOLLOWS = "document.querySelector('[data-test=script-state]').innerText.includes('Follow a tag')"
_START = "[data-test=start-script]:enabled"


class Visitor:
    """Presses with a finger what the page shows."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def sees(self, expression: str, within: float = 60.0) -> None:
        assert self.engine.until(expression, within), self.engine.evaluate("document.body.innerText")

    def insists(self, selector: str, expression: str, hold_ms: int = 0) -> None:
        """Press what the page shows, again if it had no effect: a tap is no tap where a busy machine makes it long.

        Nothing has failed then, and nothing covers STOP.
        """

        def works() -> bool:
            if self.engine.evaluate(f"Boolean(document.querySelector({selector!r}))"):
                self.engine.click(selector, hold_ms, "touch")
            return self.engine.until(expression, 10)

        assert until(works, 90), self.engine.evaluate("document.body.innerText")
        assert self.engine.evaluate(f"{REACHED}[1].concat(globalThis.complaints)") == [], selector

    def drives(self, trace: Path) -> None:
        """Drive until the motors run; control is taken again where a rest has ended it."""
        since_ns = time.monotonic_ns()
        for _ in range(20):
            if not self.engine.evaluate(_HAS_CONTROL):
                self.insists("[data-test=take]", _HAS_CONTROL)
            self.engine.press("w", ms=700)
            if any(any(seen.motors or ()) for seen in read_trace(trace) if seen.ns > since_ns):
                return
        pytest.fail("its motors did not run")


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)], ids=["desktop", "phone"])
def test_a_visitor_sees_drives_stops_and_starts_a_script(
    demos: list[Demo], temporary: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    demo, phone = start(demos, temporary, ""), size[0] < 600
    with firefox(tmp_path, size) as engine:
        visitor = Visitor(engine)
        engine.open(page_of(demo))
        engine.evaluate(_ERRORS)
        visitor.sees("document.querySelectorAll('.fleet-card').length >= 4", START_S)
        visitor.sees("document.querySelector('.thumbnail img')", 15)
        assert until(lambda: "the robots are yours" in demo.output, 120)
        visitor.insists(".fleet-card [href$='/goob']", "pebble.route.ref.endsWith('/goob')")
        visitor.sees("pebble.video.info && document.querySelector('[data-test=take]')")
        visitor.drives(trace_path(demo.folders()[0] / "world", "goob"))
        visitor.insists("[data-test=stop-one]", _STOPPED)
        visitor.insists("[data-test=reset]", "document.querySelector('[data-test=reset-hold]')")
        visitor.insists("[data-test=reset-hold]", f"!{_STOPPED}", 2000)
        if phone:
            visitor.insists("[data-test=tab-more]", _SHOWN.format("[data-test=script-apriltag-follow]"))
        visitor.insists("[data-test=script-apriltag-follow]", f"document.querySelector('{_START}')")
        visitor.insists(_START, _FOLLOWS)
        visitor.insists("[data-test=end-script]", f"!{_FOLLOWS}")
        if phone:
            visitor.insists("[data-test=settings]", _SHOWN.format('[href*="/replay/"]'))
        visitor.insists("[href*='/replay/']", "pebble.replay")
        visitor.insists("[data-test=play]", "pebble.replay.video.info")
