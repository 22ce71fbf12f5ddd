"""Every control of the fleet and of a robot's page, used in a browser; what it does is asserted at the robot."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Browser, Locator

from tests.ext.page.attacker import Everything
from tests.ext.page.browser import tab
from tests.ext.page.canned import CannedServer
from tests.ext.page.console import Console, console
from tests.ext.page.stage import Stage
from tests.ext.page.states import STATES

pytestmark = pytest.mark.alone  # deadlines are checked


# -- stops


def test_the_space_bar_ends_the_gesture_and_latches_nothing(at_lamp: Console, wire: Everything) -> None:
    assert at_lamp.drive()
    at_lamp.page.keyboard.press("Space")
    assert at_lamp.rests()
    assert at_lamp.stays_at_rest()
    assert not wire.latched("minilamp")
    assert at_lamp.press_anew()


def _in_help(robot: Console) -> None:
    """It ends a gesture, moves nothing, and leaves STOP in reach."""
    robot.page.keyboard.press("?")
    assert robot.rests()
    robot.let_go()
    robot.down("KeyW")
    assert robot.stays_at_rest()
    robot.test("stop-one").click()
    robot.page.keyboard.press("?")


def _touch(element: Locator) -> None:
    element.hover()
    element.page.mouse.down()


STOPS: dict[str, Callable[[Console], None]] = {
    "Ctrl+Space": lambda robot: robot.page.keyboard.press("Control+Space"),
    "STOP": lambda robot: robot.test("stop-one").click(),
    "STOP beside the help": lambda robot: _in_help(robot),
    "STOP, as soon as it is touched": lambda robot: _touch(robot.test("stop-one")),
}


@pytest.mark.parametrize("how", STOPS)
def test_a_stop_latches_the_robot_which_stays_at_rest(at_lamp: Console, wire: Everything, how: str) -> None:
    assert at_lamp.drive()
    STOPS[how](at_lamp)
    assert at_lamp.tab.until(lambda: wire.latched("minilamp"))
    assert at_lamp.rests()
    assert at_lamp.because("stopped")
    at_lamp.let_go()
    at_lamp.down("KeyW")
    assert at_lamp.stays_at_rest()


def test_stop_all_latches_every_robot_and_each_is_reset_by_itself(
    stage: Stage, at_lamp: Console, wire: Everything
) -> None:
    assert at_lamp.drive()
    at_lamp.test("stop-all").click()
    assert at_lamp.tab.until(lambda: all(wire.latched(name) for name in stage.robots))
    assert at_lamp.rests()
    at_lamp.let_go()
    at_lamp.test("reset").click()
    at_lamp.test("leave-stopped").click()
    at_lamp.test("reset").click()
    at_lamp.test("reset-hold").click()
    at_lamp.hold_button("reset-hold", 0.2)
    assert wire.latched("minilamp")
    at_lamp.hold_button("reset-hold")
    assert at_lamp.tab.until(lambda: not wire.latched("minilamp"))
    assert wire.latched("benjr")
    assert at_lamp.press_anew()
    at_lamp.reset("benjr")
    assert at_lamp.tab.until(lambda: not wire.latched("benjr"))


# -- control


def test_a_second_tab_stops_by_the_space_bar_and_takes_over_by_a_hold(
    browser: Browser, stage: Stage, at_lamp: Console
) -> None:
    with console(browser, stage, "minilamp", engineers=False) as second:
        assert second.because("lease")
        second.down("KeyW")
        assert second.stays_at_rest(0.2)
        second.let_go()
        assert at_lamp.drive()
        second.page.keyboard.press("Space")
        assert at_lamp.rests()
        assert at_lamp.stays_at_rest()
        at_lamp.let_go()
        assert at_lamp.drive()
        second.test("take-over").click()
        assert not second.because("", within=0.3)
        second.hold_button("take-over")
        assert at_lamp.rests()
        assert second.because("")
        assert second.press_anew()
        second.test("release").click()
        assert at_lamp.because("free")
        assert at_lamp.stays_at_rest()  # its key is still held
        at_lamp.test("take").click()
        assert at_lamp.because("", "release")
        assert at_lamp.stays_at_rest()
        assert at_lamp.press_anew()
        assert second.tab.complaints() == []


# -- without a mouse


@pytest.mark.page
def test_the_tab_key_reaches_every_control(at_lamp: Console) -> None:
    at_lamp.page.evaluate("document.activeElement.blur()")
    focusable = "a[href], button:enabled, input:enabled, select:enabled, summary, [tabindex='0']"
    count = at_lamp.page.evaluate(
        "(all) => [...document.querySelectorAll(all)].filter((one) => one.checkVisibility()).length", focusable
    )
    at_lamp.page.evaluate("window.reached = new Set()")
    for _ in range(count + 2):
        at_lamp.page.keyboard.press("Tab")
        at_lamp.page.evaluate("window.reached.add(document.activeElement)")
    assert at_lamp.page.evaluate("window.reached.delete(document.body) || true")
    assert at_lamp.page.evaluate("window.reached.size") == count


def test_a_screen_that_only_watches_sends_nothing_but_stops(browser: Browser, server: CannedServer) -> None:
    server.show(STATES["driving"])
    with tab(browser, f"{server.url}{server.state.path}?watch") as opened:
        assert opened.until("!!window.pebble?.connection.you && document.documentElement.hasAttribute('data-watch')")
        for key in ("KeyW", "KeyA", "KeyQ", "KeyF", "KeyP", "KeyT", "KeyM", "Minus", "Space"):
            opened.page.keyboard.press(key, delay=60)
        opened.page.evaluate(
            "() => { for (const one of document.querySelectorAll('main button, .banners button')) one.click() }"
        )
        assert opened.until("!!pebble.commands.act"), "the rest of the page has come"
        opened.page.evaluate("() => { pebble.commands.take(true); pebble.commands.act(pebble.driver.ref, 'reboot') }")
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: bool(server.sent("estop")))
        assert {message["op"] for message in server.received} <= {"hello", "watch", "read-logs", "stop", "estop"}
        assert {message["token"] for message in server.sent("hello")} == {""}
