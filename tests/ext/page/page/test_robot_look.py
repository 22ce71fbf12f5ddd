"""The robot's page as it is meant to look: nothing that works a robot moves by itself, and nothing is covered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from playwright.sync_api import Page

from tests.ext.page.browser import Size, Tab
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import FRED, GOOB, MAY_TAKE, STATES, at, changed, driver, estop

pytestmark = pytest.mark.page

SET = "([ref, metric, value]) => pebble.store.set(ref, metric, value)"
#: A late picture is not shown twice.
CALM = replace(STATES["full"], values=changed(STATES["full"].values, at(GOOB, "web/driver", driver())))
SHIFT = """window.shifted = 0;
new PerformanceObserver((list) => {
  for (const one of list.getEntries()) if (!one.hadRecentInput) window.shifted += one.value;
}).observe({ type: "layout-shift", buffered: true });"""
#: Places of all that drives and stops a robot, and of the buttons beside them, by what they are called.
PLACES = """() => Object.fromEntries([...document.querySelectorAll(
  ".stick, input[type=range], button, select, summary")]
  .filter((one) => one.closest(".top, .stage, .drive, .phone-drive, .float-pad, .tabs"))
  .filter((one) => one.checkVisibility() && !one.closest(".banners, .slot, .why-actions"))
  .map((one, n) => [`${n} ${one.dataset.test ?? one.textContent.trim()}`, one.getBoundingClientRect().toJSON()])
  .map(([name, { x, y, width, height }]) => [name, [x, y, width, height].map(Math.round)]))"""
#: Controls whose middle another element has.
COVERED = """() => [...document.querySelectorAll("main button, main select, main input, main a, main summary, .stick")]
  .filter((one) => one.checkVisibility({ visibilityProperty: true }))
  .filter((one) => {
    const { x, y, width, height } = one.getBoundingClientRect();
    const hit = document.elementFromPoint(x + width / 2, y + height / 2);
    return hit && !hit.closest("header, .tabs") && hit !== one && !one.contains(hit) && !hit.contains(one) &&
      !hit.closest("label")?.contains(one);
  }).map((one) => one.outerHTML.slice(0, 120))"""


def _ready(opened: Tab) -> None:
    assert opened.until("!!window.pebble?.connection.you && document.querySelectorAll('.loading').length === 0", 60)
    opened.until("!pebble.video.ref || !!pebble.video.info", 4)
    opened.page.wait_for_timeout(1800)  # cards have settled


def _stopped(page: Page) -> None:
    page.evaluate(SET, [GOOB, "web/estop", estop(1_700_000_000_000, "eve on phone")])


def _asks_to_reset(page: Page) -> None:
    _stopped(page)
    page.locator("[data-test=reset]").click()


def _silent(page: Page) -> None:
    page.evaluate(SET, [GOOB, "web/liveness", {"online": False, "silent_s": 4, "latency_ms": None}])


def _other_stopped(page: Page) -> None:
    page.evaluate(SET, [FRED, "web/estop", estop(1_700_000_000_000, "eve on phone")])


def _notice(page: Page) -> None:
    page.evaluate("pebble.connection.show('Saved as goob.png')")


TROUBLE: dict[str, Callable[[Page], None]] = {
    "a stop": _stopped,
    "a question before the reset": _asks_to_reset,
    "silence": _silent,
    "another's stop": _other_stopped,
    "a notice": _notice,
}
QUIET = replace(STATES["driving"], repeated={"online": 1.0})


@pytest.mark.parametrize("size", ["desktop", "phone", "landscape"])
@pytest.mark.parametrize("what", TROUBLE)
def test_trouble_moves_nothing_that_works_a_robot(show: Show, size: Size, what: str) -> None:
    with show(QUIET, size) as opened:
        _ready(opened)
        before = opened.page.evaluate(PLACES)
        TROUBLE[what](opened.page)
        opened.page.wait_for_timeout(400)
        after = opened.page.evaluate(PLACES)
        assert {name: place for name, place in after.items() if before.get(name, place) != place} == {}
        assert len(before) >= 5
        if size != "landscape":  # there a band may lie over what is off meanwhile, which is hidden
            assert opened.page.evaluate(COVERED) == []


def test_cards_stay_in_their_places(show: Show) -> None:
    with show(CALM, viewport={"width": 1440, "height": 900}, engineers=False, script=SHIFT) as opened:
        for _ in ("as they come", "as they are remembered"):
            _ready(opened)
            opened.page.wait_for_timeout(3000)
            assert opened.page.evaluate("window.shifted") <= 0.02
            assert opened.page.evaluate(COVERED) == []
            opened.page.reload()


def test_driving_of_a_board_that_says_nothing_is_allowed_and_withdrawn_on_its_page(
    show: Show, server: CannedServer
) -> None:
    view = {"silent": True, "by": "", "refused": "", "parked": "", "risk": "It may roll on."}
    with show(replace(STATES["free"], welcome=MAY_TAKE)) as opened:
        _ready(opened)
        opened.page.evaluate(SET, [GOOB, "capabilities", {"value": {"announced": True, "assumed": True}}])
        opened.page.evaluate(SET, [GOOB, "web/board", view])
        opened.test("board-extra").click()
        opened.test("board-allow").click()
        opened.page.evaluate(SET, [GOOB, "web/board", {**view, "by": "ann", "parked": "Clear it first"}])
        opened.test("board-clear").click()
        opened.test("board-withdraw").click()
        asked = [(one["do"], one["extra"]) for one in server.received if one.get("op") == "board"]
        assert asked == [("allow", True), ("clear", True), ("withdraw", True)]
        opened.page.evaluate(SET, [GOOB, "web/board", {**view, "refused": "The config decides that"}])
        opened.page.locator("[data-test=board-allow]:disabled").wait_for()


def test_a_small_phone_shows_all_that_drives_at_once(show: Show) -> None:
    with show(STATES["driving"], "phone", viewport={"width": 360, "height": 640}) as opened:
        _ready(opened)
        tabs = opened.page.locator(".tabs").bounding_box()
        for name in ("stick", "speed", "release", "video"):
            box = opened.test(name).bounding_box()
            assert box is not None
            assert tabs is not None
            assert box["y"] + box["height"] <= tabs["y"] + 1, name
        stick = opened.test("stick").bounding_box()
        assert stick is not None
        assert stick["width"] >= 150
