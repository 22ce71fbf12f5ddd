"""Gamepads that are injected into the page, and what they do at a robot's motors."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser

from tests.web.console import BACK, FORWARD, LEFT, Console, Wheels, Wire, console, pad, used
from tests.web.stage import Stage

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.fixture(scope="module")
def wire(lamp: Stage) -> Iterator[Wire]:
    running = Wire(lamp)
    yield running
    running.close()


@pytest.fixture(scope="module")
def _lamp_page(browser: Browser, lamp: Stage) -> Iterator[Console]:
    with console(browser, lamp, "minilamp") as opened:
        yield opened


@pytest.fixture
def at_lamp(_lamp_page: Console) -> Iterator[Console]:
    with used(_lamp_page) as ready:
        yield ready


def _drives(at_lamp: Console, *pads: dict[str, Any], wheels: Wheels = FORWARD) -> bool:
    """Show the first gamepad in neutral, then as it is."""

    def neutral() -> None:
        at_lamp.pads({**pads[0], "axes": [0, 0]}, *pads[1:])
        at_lamp.page.wait_for_timeout(120)

    neutral()
    return at_lamp.persists(lambda: at_lamp.pads(*pads), lambda: at_lamp.wheels == wheels, neutral)


def test_a_gamepad_drives_once_it_was_seen_in_neutral(at_lamp: Console) -> None:
    at_lamp.pads(pad(z=1))
    assert at_lamp.stays_at_rest()
    assert _drives(at_lamp, pad(z=1))
    assert _drives(at_lamp, pad(x=-1), wheels=LEFT)
    at_lamp.pads(pad(0.05, -0.05))
    assert at_lamp.rests()


def test_a_gamepad_that_is_disconnected_while_it_is_deflected_stops(at_lamp: Console) -> None:
    assert _drives(at_lamp, pad(z=1))
    at_lamp.pads(None)
    assert at_lamp.rests()
    at_lamp.pads(None, pad(z=1))
    assert at_lamp.stays_at_rest()
    assert _drives(at_lamp, pad(z=1))


def test_a_deflected_gamepad_whose_time_stands_still_is_given_up(at_lamp: Console) -> None:
    assert _drives(at_lamp, pad(z=1))
    began = time.monotonic()
    assert at_lamp.rests(6)
    assert time.monotonic() - began > 2.5
    assert at_lamp.reason in ("pad", "release")
    at_lamp.pads(pad(z=1))
    assert at_lamp.stays_at_rest()
    assert _drives(at_lamp, pad(z=1))


def test_of_two_gamepads_the_one_that_was_touched_last_drives(at_lamp: Console) -> None:
    second = pad(name="Logitech Attack 3")
    assert _drives(at_lamp, pad(z=1), second)
    at_lamp.page.wait_for_timeout(200)  # what two do at once is one device, listed twice
    at_lamp.pads(pad(z=1), {**second, "axes": [0, 1]})
    assert at_lamp.rests()  # it is let go first
    at_lamp.pads(pad(), second)
    at_lamp.page.wait_for_timeout(120)
    at_lamp.pads(pad(), {**second, "axes": [0, 1]})
    assert at_lamp.turns(BACK)


def test_the_buttons_of_a_gamepad_stop(at_lamp: Console, wire: Wire) -> None:
    assert _drives(at_lamp, pad(z=1))
    at_lamp.pads(pad(0, 1, 0))
    assert at_lamp.rests()
    assert at_lamp.stays_at_rest()
    assert not wire.latched("minilamp")
    assert _drives(at_lamp, pad(z=1))
    at_lamp.pads(pad(0, 1, 8, 9))
    assert at_lamp.tab.until(lambda: wire.latched("minilamp"), 2)
    assert at_lamp.rests()
