"""Whole robots with pictures, on Zenoh (goob) and on MQTT (fred), beside two on microcontrollers, in a browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.ext.page.browser import tab
from tests.ext.page.console import KEYS, Console, Wire, console, used
from tests.ext.page.stage import Stage

pytestmark = pytest.mark.page  # deadlines are checked


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    """The demo's four robots."""
    with Stage(room=False) as running:
        yield running


@pytest.mark.parametrize("name", ["goob", "fred"])
def test_keys_turn_the_wheels_while_they_are_held(browser: Browser, stage: Stage, name: str) -> None:
    with console(browser, stage, name) as opened, used(opened) as robot:
        for key, wheels in list(KEYS.items())[:4]:
            assert robot.drive(key, wheels=wheels), (key, robot.wheels, robot.reason)
            robot.let_go()
            assert robot.rests(), key


def test_stop_all_latches_robots_of_every_kind(stage: Stage, at_lamp: Console, wire: Wire) -> None:
    at_lamp.test("stop-all").click()
    assert at_lamp.tab.until(lambda: all(wire.latched(name) for name in stage.robots), 3)
    refs = [stage.ref(name) for name in stage.robots]  # the page resets those stops that it has seen
    assert at_lamp.tab.until(lambda: all(at_lamp.state("web/estop", ref)["latched"] for ref in refs), 3)
    for name in stage.robots:
        at_lamp.reset(name)
    assert at_lamp.tab.until(lambda: not any(wire.latched(name) for name in stage.robots), 3)


def test_the_fleet_never_starts_a_camera(browser: Browser, stage: Stage, wire: Wire) -> None:
    with tab(browser, stage.url) as fleet:
        assert fleet.until(lambda: fleet.page.locator(".fleet-card").count() == 4)
        asked = len(wire.received)
        assert fleet.test("card-fred").get_by_text("camera rests").is_visible()
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
