"""What a page shows while parts of it are fetched, or fail, as values age, and in people's own colours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.ext.page.browser import Size, Theme
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import FRED, GOOB, LAMP, STATES

pytestmark = pytest.mark.page

SCREEN = "**/ui/robot/robot.js"


def test_a_screen_that_cannot_be_fetched_is_tried_again_while_stop_works(show: Show, server: CannedServer):
    with show(STATES["driving"], routes={SCREEN: lambda route: route.abort()}) as opened:
        opened.page.locator(".loading").wait_for()
        opened.page.keyboard.down("KeyW")
        opened.page.wait_for_timeout(300)
        opened.page.keyboard.up("KeyW")
        assert not [one for one in server.sent("drive") if one["x"] or one["z"]]
        opened.test("stop-one").click()
        assert opened.until(lambda: server.sent("estop"))
        opened.context.unroute(SCREEN)
        again = opened.page.locator(".failed button")  # of browsers that remember that a module could not be fetched
        opened.test("why").first.or_(again).wait_for()
        if again.count():
            again.click()
        opened.test("why").first.wait_for()
        assert opened.until(lambda: opened.page.locator(".loading").count() == 0)  # those of cards come and go


STOPPED = """(refs) => refs.forEach((ref) => pebble.store.set(
  ref, "web/estop", { ...pebble.store.get(ref, "web/estop").value, latched: true, by: "eve" }))"""


def test_stops_are_read_aloud_whatever_comes_right_after_them(show: Show) -> None:
    with show(STATES["fleet"]) as opened:
        opened.test("bell").wait_for()
        opened.page.evaluate(STOPPED, [FRED, LAMP])
        opened.page.evaluate("(ref) => pebble.store.set(ref, 'web/liveness', { online: false })", GOOB)
        announced = opened.test("announcement")
        stops = "fred was stopped by eve. minilamp was stopped by eve"
        assert opened.until(lambda: stops in announced.inner_text()), announced.inner_text()
        opened.test("bell").click()
        assert opened.until(lambda: announced.inner_text() == "")


def test_a_button_that_is_switched_off_while_it_is_held_does_nothing(show: Show, server: CannedServer) -> None:
    with show(STATES["stopped"]) as opened:
        opened.test("reset").click()
        opened.test("reset-hold").hover()
        opened.page.evaluate("pebble.pressedAt = performance.now()")
        opened.page.mouse.down()
        opened.page.locator(".held").wait_for()
        opened.page.evaluate("pebble.connection.may = () => false; pebble.connection.changed()")
        assert opened.until(lambda: opened.page.locator(".held").count() == 0, 0.9)
        opened.page.evaluate("delete pebble.connection.may; pebble.connection.changed()")
        assert opened.until("performance.now() - pebble.pressedAt > 1500")
        assert server.sent("estop-reset") == []


# -- values that age

SEND = """async ([ref, count]) => {
  for (let i = 0; i < count; i++) {
    pebble.store.set(ref, "charging-level", { value: 7, unit: "v" });
    await new Promise((resolve) => setTimeout(resolve, 60));
  }
}"""


def test_a_value_that_stops_becomes_late_and_the_next_one_is_fresh(show: Show) -> None:
    state = replace(STATES["fleet"], repeated={})
    with show(state) as opened:
        level = opened.test("card-goob").get_by_text("7.00 V")
        opened.test("card-goob").wait_for()
        opened.page.evaluate(SEND, [GOOB, 6])
        assert opened.until(lambda: level.inner_text() == "7.00 V 0 s old", 3), level.inner_text()
        assert opened.until(lambda: level.inner_text() == "7.00 V 2 s old", 4), level.inner_text()
        opened.page.evaluate(SEND, [GOOB, 1])
        assert opened.until(lambda: level.inner_text() == "7.00 V", 1), level.inner_text()
        assert opened.until(lambda: level.inner_text() == "7.00 V 0 s old", 3), level.inner_text()


# -- colours, and what still loads

#: What is drawn, and how: its pixels are not all of one colour.
DRAWN = [".knob", ".stick-arrow.n", ".stick-arrow.e", ".stick-arrow.s", ".stick-arrow.w"]
#: How many texts say that a part loads; how many of them lie over a control, and how many leave their card.
COVERED = """(() => {
  const place = (one) => one.getBoundingClientRect();
  const texts = [...document.querySelectorAll(".loading")]
    .filter((one) => one.checkVisibility() && place(one).height > 0);
  const controls = [...document.querySelectorAll("button, a, input, select, .stick")]
    .filter((one) => !one.closest(".tabs, header, .skip")); // the page scrolls below these
  const wide = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left);
  const over = (a, b) => wide(a, b) > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1;
  const covers = (one) => controls.some((two) => over(place(one), place(two)));
  const leaves = (one) => place(one).bottom > place(one.closest(".card") ?? document.documentElement).bottom + 1;
  return [texts.length, texts.filter(covers).length, texts.filter(leaves).length];
})()"""
#: Among them the settings below the stick, and a sheet of theirs.
LATE = ("drive-settings.js", "telemetry.js", "map.js", "lights.js", "plots.js", "panels.css")


@pytest.mark.parametrize(("size", "theme"), [("desktop", "light"), ("phone", "dark")])
def test_the_stick_is_seen_in_forced_colours(show: Show, size: Size, theme: Theme) -> None:
    with show(STATES["driving"], size, theme=theme, forced_colors="active") as opened:
        opened.uncover("stick")
        sheet = "getComputedStyle(document.querySelector('.knob')).forcedColorAdjust === 'none'"
        assert opened.until(sheet)
        for one in DRAWN:
            data = np.frombuffer(opened.page.locator(one).first.screenshot(), np.uint8)
            picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            assert int(picture.max()) - int(picture.min()) > 100, one
        left = "document.querySelector('.stick-arrow.n')"
        assert opened.page.evaluate(f"getComputedStyle({left}).borderLeftColor") == "rgba(0, 0, 0, 0)", "a triangle"


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_what_still_loads_lies_over_nothing(show: Show, size: Size) -> None:
    late = {f"**/{name}": lambda _: None for name in LATE}  # they never come
    with show(STATES["driving"], size, routes=late) as opened:
        assert opened.until(f"{COVERED}[0] > 0", 20)
        assert opened.until(f"{COVERED}.slice(1).join() === '0,0'", 5), opened.page.evaluate(COVERED)
