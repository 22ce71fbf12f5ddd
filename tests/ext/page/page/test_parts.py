"""What a page shows while parts of it are fetched, or fail, as values age, and in people's own colours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.ext.page.browser import Size, Theme, answer
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import FRED, GOOB, LAMP, STATES

pytestmark = pytest.mark.page

SCREEN = "**/ui/robot/robot.js"
LATER = "fleet", "cards", "drive", "stick", "video", "settings"
SHOWN = "document.querySelector('.vital .chip:last-child').innerText + document.querySelector('.pad-words').innerText"
HERE = r"performance.getEntriesByType('resource').map((one) => one.name.match(/(\w+).js$/)?.[1])"


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


def test_the_other_screens_are_here_without_a_server(show: Show):
    with show(STATES["fleet"]) as opened:
        assert opened.until(lambda: set(LATER) <= set(opened.page.evaluate(HERE)))
        opened.context.set_offline(True)
        opened.page.locator("[data-test^=card-]", has_text="goob").locator("a").first.click()
        opened.test("why").first.wait_for()
        opened.test("settings").click()
        opened.test("theme-dark").wait_for()


def test_only_one_panel_is_open(show: Show) -> None:
    with show(STATES["driving"]) as opened:
        opened.test("bell").click()
        opened.test("panel-notices").wait_for()
        opened.test("help").click()
        opened.test("panel-help").wait_for()
        assert opened.until(lambda: opened.page.locator("dialog").count() == 1)
        opened.test("bell").click()
        opened.test("panel-notices").wait_for()
        assert opened.until(lambda: opened.page.locator("dialog").count() == 1)


def test_a_driver_sees_that_the_robot_can_no_longer_be_driven_and_then_that_it_can(show: Show) -> None:
    with show(STATES["driving"]) as opened:
        opened.test("bell").wait_for()
        for state, chip, hint in (
            ("yes", "You drive", "drag the stick"),
            ("no", "Not driving", ""),
            ("unknown", "You drive", "drag the stick"),
            ("yes", "You drive", "drag the stick"),
        ):
            status = {"value": {"services": {}, "driveable": {"state": state, "why": "serial: no board"}}}
            opened.page.evaluate("([ref, status]) => pebble.store.set(ref, 'status', status)", [GOOB, status])
            opened.page.wait_for_timeout(300)  # what is replaced before it is drawn nobody sees
            assert opened.until(f"{SHOWN} === '{chip}{hint}'"), opened.page.evaluate(SHOWN)
        opened.test("bell").click()
        assert opened.until("document.querySelector('.notice-driveable')?.innerText.includes('can be driven again')")


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


def test_the_picture_outlives_what_belongs_to_it(show: Show):
    """What a robot reports of its own stream is drawn by a part that is fetched later; here that part fails."""
    broken = "export const Layer = () => { throw new Error('broken'); }; export const Tools = Layer;"
    extras = {"**/ui/robot/picture-extras.js": answer(broken)}
    with show(STATES["driving"], routes=extras) as opened:
        assert opened.until(lambda: opened.page.locator(".failed").count() == 2)
        assert opened.until(lambda: opened.page.locator(".canvas canvas").is_visible())
        assert opened.test("video").is_enabled()


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


def test_the_state_of_an_earlier_connection_allows_no_driving(show: Show, server: CannedServer) -> None:
    state = replace(STATES["driving"], repeated={})
    reason = "pebble.driver.reason()?.code"
    with show(state) as opened:
        assert opened.until(f"window.pebble && {reason} === undefined", 10)
        # another server answers, and what it knows comes a moment later
        assert opened.page.evaluate(f"pebble.driver.socket.welcome(pebble.driver.socket.you), {reason}") == "connecting"


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
LATE = ("drive-settings.js", "key-hints.js", "telemetry.js", "map.js", "lights.js", "plots.js", "panels.css")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", ["desktop", "phone"])
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
