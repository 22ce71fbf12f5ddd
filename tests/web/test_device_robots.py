"""Outlets and microcontrollers of a whole robot, by the page: what counts is what the relays of the station do."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.web.console import Console, console
from tests.web.stage import Stage

pytestmark = [pytest.mark.alone, pytest.mark.timeout(120)]
_SWITCHES_S = 5.0


@pytest.fixture(scope="module")
def goob() -> Iterator[Stage]:
    with Stage("goob", room=False) as running:
        yield running


@pytest.fixture(scope="module")
def page(browser: Browser, goob: Stage) -> Iterator[Console]:
    with console(browser, goob, "goob") as opened:
        opened.test("outlet-o1").wait_for(timeout=20_000)
        yield opened
        assert opened.tab.complaints() == []


def switched(page: Console, *changes: str) -> bool:
    """Whether these are the newest changes of the relays."""
    return page.tab.until(lambda: page.stage.relays("goob")[-len(changes) :] == list(changes), _SWITCHES_S)


def test_a_relay_is_switched_on_and_off(page: Console) -> None:
    switch = page.test("outlet-o1")
    switch.click()
    assert switched(page, "o1 on")
    assert page.tab.until(lambda: switch.get_attribute("aria-checked") == "true")
    assert page.test("outlet-asked-o1").count() == 0
    switch.click()
    assert switched(page, "o1 on", "o1 off")
    assert page.tab.until(lambda: page.test("outlet-state-o1").inner_text() == "off")


def test_an_unreachable_outlet_has_its_reason(page: Console) -> None:
    switch = page.test("outlet-o4")
    assert switch.is_disabled()
    why = page.page.locator(f'[id="{switch.get_attribute("aria-describedby")}"]')
    assert why.inner_text() == "outlet is unreachable"


def test_a_generated_form_reaches_the_microcontroller(page: Console) -> None:
    form = page.test("mcu-in-o2_set")
    form.locator('[data-test="field-on"]').check()
    page.test("send-o2_set").click()
    assert switched(page, "o2 on")
    assert page.tab.until(lambda: page.test("outlet-state-o2").inner_text() == "on")


def test_what_a_microcontroller_measures_is_shown(page: Console) -> None:
    values = page.test("mcu-out-imu")
    assert page.tab.until(lambda: "accel_norm_g" in values.inner_text())
    assert page.tab.until(lambda: "/s" in values.inner_text())
    assert "stays on the robot" in page.test("mcu-out-imu_fast").inner_text()
