"""The keys of an emergency stop, in every state in which a browser may take keys for itself."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.ext.page.browser import Tab
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import STATES
from tests.support import some


def _full_screen(opened: Tab) -> None:
    opened.page.evaluate("document.documentElement.requestFullscreen()")
    assert opened.until("document.fullscreenElement !== null")


def _list(opened: Tab) -> None:
    opened.test("picker").click()
    assert opened.until("document.querySelector('select:open') !== null")


def _dialog(opened: Tab) -> None:
    opened.test("settings").click()
    assert opened.until("document.querySelector('dialog[open]') !== null")


def _composition(opened: Tab) -> None:
    _dialog(opened)
    opened.page.locator("dialog input[type=text]").click()
    opened.cdp().send("Input.imeSetComposition", {"text": "にほ", "selectionStart": 2, "selectionEnd": 2})


STATE = replace(STATES["free"], welcome={"login": False})
_BUTTON = """document.querySelector("[aria-label='Leave full screen']")"""
WHERE: dict[str, Callable[[Tab], object]] = {
    "nothing": lambda _: None,
    "full screen": _full_screen,
    "an open list": _list,
    "a dialog": _dialog,
    "a composition": _composition,
    "another window": lambda opened: opened.blur(),
}
KEYS = {
    "Ctrl+Enter": ("Control+Enter",),
    "⌘+Enter": ("Meta+Enter",),
    "Ctrl+Space": ("Control+Space",),
    "Escape twice": ("Escape", "Escape"),
}
#: How often keys are pressed before the page sees them: an open list takes them, and Enter and Escape close it.
TAKEN = {("an open list", "Ctrl+Enter"): 1, ("an open list", "⌘+Enter"): 1}
NEVER = ("an open list", "Ctrl+Space")
ROWS = [row for row in itertools.product(WHERE, KEYS) if row != NEVER]


def stopped(server: CannedServer) -> bool:
    """True if a stop has come, perhaps by a request: a name that was typed begins a new connection."""
    return bool(server.sent("estop") or server.posted)


@pytest.mark.parametrize(("where", "keys"), some(ROWS, 3))
def test_keys_stop(show: Show, server: CannedServer, where: str, keys: str) -> None:
    with show(STATE, when="pebble.connection.isOpen") as opened:
        WHERE[where](opened)
        for key in KEYS[keys] * (1 + TAKEN.get((where, keys), 0)):
            opened.page.keyboard.press(key)
        assert opened.until(lambda: stopped(server), 2)


@pytest.mark.parametrize("where", some(WHERE, 3))
def test_one_escape_stops_nothing(show: Show, server: CannedServer, where: str) -> None:
    with show(STATE, when="pebble.connection.isOpen") as opened:
        WHERE[where](opened)
        opened.page.keyboard.press("Escape")
        assert not opened.until(lambda: stopped(server), 0.8)


@pytest.mark.parametrize(("leave", "stops"), [("document.exitFullscreen()", True), (f"{_BUTTON}.click()", False)])
def test_full_screen_that_the_page_did_not_end_is_an_escape(
    show: Show, server: CannedServer, leave: str, stops: bool
) -> None:
    """A browser leaves it by the first one, and shows the page no key."""
    with show(STATE, when="pebble.connection.isOpen") as opened:
        _full_screen(opened)
        assert opened.until(f"{_BUTTON} !== null")
        opened.page.evaluate(leave)
        assert opened.until("document.fullscreenElement === null")
        opened.page.keyboard.press("Escape")
        assert opened.until(lambda: stopped(server), 0.5) is stops
