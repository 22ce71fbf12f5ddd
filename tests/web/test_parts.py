"""Parts of the page that are fetched when they are first shown, and where that fails."""

from __future__ import annotations

import pytest

from tests.web.browser import answer
from tests.web.canned import CannedServer, Show
from tests.web.states import GOOB, STATES

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
            assert opened.until(f"{SHOWN} === '{chip}{hint}'"), opened.page.evaluate(SHOWN)
        opened.test("bell").click()
        assert opened.until("document.querySelector('.notice-driveable').innerText.includes('can be driven again 2')")


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
