"""Whole robots on Zenoh (goob) and on MQTT (fred), beside microcontrollers, in a browser: pictures, a restart."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.ext.page.browser import tab
from tests.ext.page.console import Console, Wire, console, used
from tests.ext.page.stage import Stage

pytestmark = pytest.mark.page  # deadlines are checked


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    """The demo's four robots."""
    with Stage() as running:
        yield running


def test_the_fleet_never_starts_a_camera(browser: Browser, stage: Stage, wire: Wire) -> None:
    with tab(browser, stage.url) as fleet:
        assert fleet.until(lambda: fleet.page.locator(".fleet-card").count() == 4)
        asked = len(wire.received)
        assert fleet.test("card-fred").locator(".faced").is_visible()
        fleet.test("card-fred").hover()
        fleet.page.wait_for_timeout(1000)
        assert not [one for one in wire.received[asked:] if one[0].endswith("/front-camera") and one[1]["enabled"]]
        assert fleet.complaints() == []


def test_the_camera_runs_while_its_picture_is_shown(browser: Browser, stage: Stage, wire: Wire) -> None:
    with console(browser, stage, "fred") as robot, used(robot):
        assert robot.tab.until(lambda: wire.camera("fred"), 5)
        assert robot.tab.until("window.pebble.video.info?.encoding === 'h264'")
        robot.test("video").click()
        assert robot.tab.until("window.pebble.video.ref === ''", 1)
        assert robot.because("", within=1)  # without a picture that is wanted none is too old
        assert robot.press_anew()
        assert robot.tab.until(lambda: wire.last("fred/incoming/front-camera") == {"enabled": False}, 8)
        assert robot.tab.until(lambda: wire.last("fred/incoming/flags/mqtt-video") == {"value": False}, 1)
        robot.test("video").click()
        assert robot.tab.until("window.pebble.video.info !== null")
        assert wire.last("fred/incoming/flags/mqtt-video") == {"value": True}


def test_after_a_lost_server_pictures_come_again(browser: Browser, stage: Stage) -> None:
    with console(browser, stage, "fred") as robot:
        assert robot.tab.until("window.pebble?.video.info")
        stage.restart_server()
        assert robot.tab.until("window.pebble.video.age().ms > 1500", 5)
        assert robot.tab.until("window.pebble.video.age().ms < 1000", 20)


def test_a_robot_shows_the_picture_of_another_which_must_be_new(at_lamp: Console, stage: Stage, wire: Wire) -> None:
    at_lamp.page.evaluate(
        "([ref, source]) => window.pebble.commands.setPictureFrom(ref, source)", [at_lamp.ref, stage.ref("goob")]
    )
    assert at_lamp.tab.until("window.pebble.video.info !== null")
    assert at_lamp.tab.until(lambda: wire.camera("goob"), 5)
    at_lamp.take()
    assert at_lamp.drive()
    wire.publish("goob/incoming/flags/mqtt-video", {"value": False}, retain=True)
    assert at_lamp.because("picture", within=6)
    assert at_lamp.rests()
    at_lamp.test("see").click()
    assert at_lamp.stays_at_rest()  # its key is still held
    assert at_lamp.press_anew()
    wire.publish("goob/incoming/flags/mqtt-video", {"value": True}, retain=True)
    assert at_lamp.tab.until("window.pebble.video.age().ms < 1000")
    at_lamp.tab.gear()
    at_lamp.test("picture-from").select_option(stage.ref("fred"))
    assert at_lamp.tab.until(lambda: at_lamp.page.evaluate("window.pebble.video.ref") == stage.ref("fred"), 3)
    assert at_lamp.tab.until("window.pebble.video.info !== null")
    at_lamp.test("picture-from").select_option("")
    assert at_lamp.tab.until("window.pebble.video.ref === ''", 3)


def asks_to_restart(robot: Console) -> bool:
    """Hold until it was asked: on a busy machine a hold may end early."""
    if not robot.test("ask-hold").count():
        robot.uncover("service-restart").click()
    robot.hold_button("ask-hold")
    return robot.tab.until("document.querySelector('[data-test=outcome]')?.innerText.includes('asked')", 5)


def test_a_restart_that_another_page_asks_for_ends_a_gesture_and_moves_nothing(browser: Browser, stage: Stage) -> None:
    with console(browser, stage, "goob") as asking, console(browser, stage, "goob") as driver:
        driver.test("video").click()  # its picture would end the gesture, too
        with used(driver, complaints=False):
            assert driver.drive()
            assert asks_to_restart(asking) or asks_to_restart(asking)
            assert driver.rests(3)
            assert driver.stays_at_rest()  # its key is still held
            assert driver.tab.until(lambda: driver.state("web/driver")["you"], 15)
            assert driver.because("release", "picture", "", within=15)
            assert driver.press_anew()
        assert asking.tab.complaints() == []
