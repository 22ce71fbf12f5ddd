"""What a page shows while parts of it are fetched, or fail, as values age, and in people's own colours."""

from __future__ import annotations

import pytest

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
