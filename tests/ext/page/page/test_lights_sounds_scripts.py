"""The cards Lights, Sounds and Autonomy in a browser, before a robot that records what it is asked."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser

from tests.ext.page.browser import Tab, tab
from tests.ext.page.served import Served
from tests.ext.page.states import setting
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker

pytestmark = pytest.mark.page

BASE = "pebble/robots/recorder"
#: It does not arbitrate drive commands.
OFFERED = {"available": True, "controls": True}
CAPABILITIES = {"drive": OFFERED, "soundboard": OFFERED, "autonomy": OFFERED, "lights": {"solid": True, "flash": True}}
CLIPS = ["horn.wav", "signals/beep.wav", *(f"speech/number {number}.wav" for number in range(300))]
CONFIGS = [
    setting("tag_id", "Tag ID", "int", required=True, min=0, max=34),
    setting("distance", "Distance (m)", "float", 0.6, min=0.2, max=3.0),
    setting("search", "Search", "bool", True),
    setting("family", "Family", "enum", "25H9", options=["25H9", "36H11"]),
    setting("name", "Name", "string", "tag"),
]
SCRIPTS = [
    {"file": "april-follow", "label": "Follow a tag", "main": ["search"], "configs": CONFIGS},
    {"file": "circle", "label": "Drive in a circle", "configs": []},
]
IDLE: dict[str, Any] = {"running": False, "timestamp": 1.0, "dependencies": []}
IDLE |= dict.fromkeys(("file", "pid", "error", "config"))
QUIET: dict[str, Any] = {"playing": False, "file": None, "error": None, "timestamp": 1.0}
PIDS = itertools.count(100)


def running(file: str = "april-follow", **more: Any) -> dict[str, Any]:
    return IDLE | {"running": True, "file": file, "pid": next(PIDS), "config": {"tag_id": 7, "distance": 0.8}} | more


class Robot(RecordingRobot):
    """What it was asked since ``forget``."""

    def asked(self, metric: str) -> list[Any]:
        topic = f"{self.base}/incoming/{metric}"
        return [payload for _, name, payload in list(self.received) if name == topic]

    def show(self, metric: str, value: Any) -> None:
        self.publish(metric, value, retain=True)


@pytest.fixture(scope="module")
def robot(broker: Broker) -> Iterator[Robot]:
    with Robot(broker.port, BASE, capabilities=CAPABILITIES) as one:
        yield one


@pytest.fixture(scope="module")
def _tab(browser: Browser, served: Served, robot: Robot) -> Iterator[Tab]:
    with tab(browser, f"{served.origin}/r/{BASE}") as opened:
        yield opened


@pytest.fixture
def opened(_tab: Tab, robot: Robot) -> Iterator[Tab]:
    """The page of a robot at rest, with no complaints at the end."""
    robot.show("soundboard-files", {"files": CLIPS, "controls": True, "timestamp": 1.0})
    robot.show("soundboard-status", QUIET)
    robot.show("autonomy-files", {"files": SCRIPTS, "controls": True, "timestamp": 1.0})
    robot.show("autonomy-status", IDLE)
    assert _tab.until(lambda: _tab.test("clip").count() > 0 and _tab.test("scripts").count() == 1)
    assert _tab.until(lambda: _tab.test("lights-solid").is_enabled())
    robot.received.clear()
    before = len(_tab.complaints())
    yield _tab
    assert _tab.complaints()[before:] == []


def text(opened: Tab, name: str) -> str:
    return str(opened.test(name).inner_text())


# -- lights and sounds


BLUE, BLACK = {"b": 1.0, "g": 0.0, "r": 0.0}, {"b": 0.0, "g": 0.0, "r": 0.0}


def test_lights_solid_flashing_and_off(opened: Tab, robot: Robot) -> None:
    opened.test("colour-blue").click()
    assert opened.until(lambda: robot.asked("lights-solid") == [BLUE])
    period = opened.test("lights-period")
    for typed, shown in (("0.5", "0.5"), ("99", "0.5")):
        period.fill(typed)
        period.press("Enter")
        assert period.input_value() == shown
    opened.test("lights-flash").click()
    assert opened.until(lambda: robot.asked("lights-flash") == [BLUE | {"period": 0.5}])
    opened.test("lights-off").click()
    assert opened.until(lambda: robot.asked("lights-solid")[1:] == [BLACK])
    assert opened.test("lights-off").get_attribute("aria-pressed") == "true"


def test_a_clip_is_found_played_and_stopped(opened: Tab, robot: Robot) -> None:
    assert text(opened, "more-clips") == "… 242 more: use the filter."
    opened.test("sound-filter").fill("NUMBER 299")
    assert opened.until(lambda: opened.test("clip").count() == 1)
    opened.test("clip").click()
    assert opened.until(lambda: robot.asked("soundboard-command"))
    name = "speech/number 299.wav"
    assert robot.asked("soundboard-command") == [{"action": "play", "enabled": True, "file": name}]
    robot.show("soundboard-status", QUIET | {"playing": True, "file": name})
    assert opened.until(lambda: name in text(opened, "playing"))
    opened.test("clip").click()  # it plays: the same button ends it
    assert opened.until(lambda: len(robot.asked("soundboard-command")) == 2)
    assert robot.asked("soundboard-command")[1]["action"] == "stop"
    opened.test("sound-filter").fill("")


# -- scripts


def show_script(opened: Tab, file: str) -> None:
    """Open the form of this script."""
    row = opened.test(f"script-{file}")
    if row.get_attribute("aria-expanded") == "false":
        row.click()
    opened.page.locator(f'[data-test="script-{file}"][aria-expanded="true"]').wait_for()


def test_a_form_is_sent_when_the_browser_finds_no_mistake_and_its_script_is_ended(opened: Tab, robot: Robot) -> None:
    def refuses(name: str) -> bool:
        start.click()
        return opened.page.evaluate("document.activeElement.dataset.test") == f"set-{name}"

    show_script(opened, "april-follow")
    start = opened.test("start-script")
    assert opened.until(start.is_enabled)
    assert refuses("tag_id")  # it is required
    opened.test("set-tag_id").fill("35")
    assert refuses("tag_id")
    opened.test("set-tag_id").fill("7")
    opened.test("more-settings").click()
    distance = opened.test("set-distance")
    distance.fill("-5")
    opened.page.evaluate("document.querySelector('.script-more').open = false")
    assert refuses("distance")  # what it refuses is in sight
    opened.test("restore-distance").click()
    assert distance.input_value() == "0.6"
    assert robot.asked("autonomy-command") == []
    opened.test("set-search").uncheck()
    opened.test("set-family").select_option("36H11")
    start.click()
    assert opened.until(lambda: robot.asked("autonomy-command"))
    config = {"tag_id": 7, "search": False, "family": "36H11"}
    assert robot.asked("autonomy-command") == [{"action": "start", "file": "april-follow", "config": config}]
    robot.show("autonomy-status", running(since=1_700_000_000.5))
    assert opened.until(lambda: " runs, since " in text(opened, "script-state"))
    opened.test("end-script").click()
    assert opened.until(lambda: robot.asked("autonomy-command")[1:] == [{"action": "stop"}])
    robot.show("autonomy-status", IDLE | {"error": "april-follow exited with code 1"})
    assert opened.until(lambda: "exited with code 1" in text(opened, "script-error"))


# -- driving beside a script, at a robot that does not arbitrate


@pytest.fixture
def driver(opened: Tab, robot: Robot) -> Iterator[Tab]:
    """It has the control."""
    opened.page.evaluate("document.activeElement.blur()")
    opened.test("take").click()
    assert opened.until("window.pebble.driver.reason() === null")
    yield opened
    opened.page.keyboard.up("KeyW")
    opened.test("release").click()
    assert opened.until("window.pebble.driver.reason()?.code === 'free'")


def moves(robot: Robot) -> bool:
    return any(one["z"] for one in robot.asked("drive-values"))


def test_a_person_has_to_stop_the_script_and_to_press_again(driver: Tab, robot: Robot) -> None:
    robot.show("autonomy-status", running())
    driver.test("stop-script").wait_for()
    assert text(driver, "stop-script") == "Stop script"
    assert "april-follow is driving: stop it first" in text(driver, "why")
    driver.page.keyboard.down("KeyW")
    driver.test("stop-script").click()
    assert driver.until(lambda: robot.asked("autonomy-command") == [{"action": "stop"}])
    robot.show("autonomy-status", IDLE)
    assert driver.until("window.pebble.driver.reason()?.code === 'release'")
    driver.page.wait_for_timeout(300)  # six commands of a gesture
    assert not moves(robot)
    driver.page.keyboard.up("KeyW")
    driver.page.keyboard.down("KeyW")
    assert driver.until(lambda: moves(robot))


# -- robots that write anything

MARKUP = "<img src=x onerror=alert(1)>"
LONG = "long " * 2000


def test_what_a_robot_writes_is_only_text(opened: Tab, robot: Robot) -> None:
    form = {"file": MARKUP, "label": LONG, "configs": [setting(MARKUP, MARKUP, "string", MARKUP)]}
    robot.show("soundboard-files", {"files": [MARKUP, LONG]})
    robot.show("soundboard-status", {"playing": True, "file": LONG, "error": MARKUP})
    robot.show("autonomy-files", {"files": [form]})
    robot.show("autonomy-status", running(LONG, error=MARKUP, config={MARKUP: LONG}))
    assert opened.until(lambda: MARKUP in text(opened, "script-error") and MARKUP in text(opened, "sound-error"))
    opened.page.locator(".script-row").click()
    opened.page.locator(".ask-field").wait_for()
    assert opened.page.locator(".failed, img").count() == 0
    assert opened.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
