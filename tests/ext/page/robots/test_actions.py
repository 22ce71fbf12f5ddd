"""Keys and buttons besides driving, gamepads, and screens that only watch; asserted at robot and broker."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from playwright.sync_api import Browser

from tests.ext.page.browser import Tab, answer, tab
from tests.ext.page.canned import CannedServer
from tests.ext.page.console import FORWARD, LEFT, Console, Wheels, Wire, console, pad, used
from tests.ext.page.stage import Stage
from tests.ext.page.states import STATES

pytestmark = pytest.mark.alone  # deadlines are checked

#: What other parts of the page would do, as a list of calls.
_MODULES = {
    "lights-model.js": "export const toggleFlash = (page, ref) => { calls.push(['flash', ref]); return ''; };",
    "sounds-model.js": "export const repeatLast = (page, ref) => { calls.push(['repeat', ref]); return 'No, why'; };",
}
_SOUND = """() => {
  window.calls = [];
  pebble.sound = { talk: (on) => calls.push(["talk", on]), toggleMute: () => calls.push(["mute"]) };
}"""


@pytest.fixture(scope="module")
def _benjr_page(browser: Browser, stage: Stage) -> Iterator[Console]:
    with console(browser, stage, "benjr", engineers=False) as opened:
        for name, source in _MODULES.items():
            opened.page.route(f"**/ui/cards/{name}", answer(source))
        opened.tab.until("!!window.pebble?.driver.actions")
        opened.page.evaluate(_SOUND)
        yield opened


@pytest.fixture
def at_benjr(_benjr_page: Console) -> Iterator[Console]:
    with used(_benjr_page) as ready:
        ready.page.evaluate("() => { calls.length = 0 }")
        yield ready


def _calls(robot: Console) -> Any:
    return robot.page.evaluate("calls")


# -- keys


def test_the_help_ends_a_gesture_and_leaves_stop_in_reach(at_benjr: Console, wire: Wire) -> None:
    assert at_benjr.drive()
    at_benjr.page.keyboard.press("?")
    assert at_benjr.rests()
    assert at_benjr.test("panel-help").is_visible()
    assert "no safety-rated stop" in at_benjr.test("panel-help").inner_text()
    at_benjr.let_go()
    at_benjr.down("KeyW")
    assert at_benjr.stays_at_rest()
    at_benjr.test("stop-one").click()
    assert at_benjr.tab.until(lambda: wire.latched("benjr"), 2)
    at_benjr.page.keyboard.press("?")
    assert at_benjr.tab.until("document.querySelector('dialog[open]') === null", 2)
    assert at_benjr.because("stopped", within=5)
    at_benjr.take()
    assert at_benjr.press_anew()


def test_keys_call_what_they_are_for_and_end_no_gesture(at_benjr: Console) -> None:
    assert at_benjr.drive()
    for key in ("KeyF", "KeyP", "KeyM"):
        at_benjr.page.keyboard.press(key)
    at_benjr.down("KeyT")
    assert at_benjr.tab.until(lambda: len(_calls(at_benjr)) == 4, 2)
    assert sorted(_calls(at_benjr)) == [["flash", at_benjr.ref], ["mute"], ["repeat", at_benjr.ref], ["talk", True]]
    assert "Not done: No, why" in at_benjr.page.inner_text(".banners")
    assert at_benjr.wheels == FORWARD
    at_benjr.let_go()
    assert at_benjr.rests()
    assert at_benjr.tab.until(lambda: _calls(at_benjr)[-1] == ["talk", False], 1)


# -- gamepads


def _drives(at_benjr: Console, shown: dict[str, Any], wheels: Wheels = FORWARD) -> bool:
    """Show a gamepad in neutral, then as it is."""

    def neutral() -> None:
        at_benjr.pads({**shown, "axes": [0] * len(shown["axes"])})
        at_benjr.page.wait_for_timeout(120)

    neutral()
    return at_benjr.persists(lambda: at_benjr.pads(shown), lambda: at_benjr.wheels == wheels, neutral)


def test_a_gamepad_drives_once_it_was_seen_in_neutral(at_benjr: Console) -> None:
    at_benjr.pads(pad(z=1))
    assert at_benjr.stays_at_rest()
    assert _drives(at_benjr, pad(z=1))
    assert _drives(at_benjr, pad(x=-1), wheels=LEFT)
    at_benjr.pads(pad(0.05, -0.05))
    assert at_benjr.rests()


def test_the_buttons_of_a_gamepad_stop(at_benjr: Console, wire: Wire) -> None:
    assert _drives(at_benjr, pad(z=1))
    at_benjr.pads(pad(0, 1, 0))
    assert at_benjr.rests()
    assert at_benjr.stays_at_rest()
    assert not wire.latched("benjr")
    assert _drives(at_benjr, pad(z=1))
    at_benjr.pads(pad(0, 1, 8, 9))
    assert at_benjr.tab.until(lambda: wire.latched("benjr"), 2)
    assert at_benjr.rests()
    assert at_benjr.because("stopped", within=2)  # else the next test would not see what it has to reset


# -- screens that only watch


@contextmanager
def _watching(browser: Browser, url: str) -> Iterator[Tab]:
    with tab(browser, f"{url}?watch") as opened:
        assert opened.until("!!window.pebble?.connection.you && document.documentElement.hasAttribute('data-watch')")
        yield opened


def test_a_screen_that_only_watches_sends_nothing_but_stops(browser: Browser, server: CannedServer) -> None:
    server.show(STATES["driving"])
    with _watching(browser, server.url + server.state.path) as opened:
        for key in ("KeyW", "KeyA", "KeyQ", "KeyF", "KeyP", "KeyT", "KeyM", "Minus", "Space"):
            opened.page.keyboard.press(key, delay=60)
        opened.page.evaluate(
            "() => { for (const one of document.querySelectorAll('main button, .banners button')) one.click() }"
        )
        assert opened.until("!!pebble.commands.act"), "the rest of the page has come"
        opened.page.evaluate("() => { pebble.commands.take(true); pebble.commands.act(pebble.driver.ref, 'reboot') }")
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: bool(server.sent("estop")), 2)
        assert {message["op"] for message in server.received} <= {"hello", "watch", "read-logs", "stop", "estop"}
        assert [message["token"] for message in server.sent("hello")] == [""]


def test_it_stops_robots_and_never_drives(browser: Browser, stage: Stage, wire: Wire) -> None:
    with _watching(browser, stage.robot_url("benjr")) as opened:
        assert opened.until("window.pebble.store.get(pebble.driver.ref, 'web/liveness')?.value.online === true")
        before = len(wire.all("benjr/incoming/drive-values"))
        opened.page.keyboard.press("KeyW", delay=200)
        assert not opened.page.evaluate("pebble.store.get(pebble.driver.ref, 'web/driver')?.value.you")
        assert len(wire.all("benjr/incoming/drive-values")) == before
        opened.test("stop-one").click()
        assert opened.until(lambda: wire.latched("benjr"), 2)
        assert opened.page.locator("[data-test=reset]:visible").count() == 0
        assert opened.complaints() == []
    with console(browser, stage, "benjr", engineers=False) as robot:
        robot.take()  # resets it
