"""The cards Lights, Sounds and Autonomy in a browser, before a robot that records what it is asked."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator

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
SUMMARY = "Drives towards a printed tag."
SCRIPTS = [
    {"file": "april-follow", "label": "Follow a tag", "summary": SUMMARY, "main": ["search"], "configs": CONFIGS},
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


def why(control: Locator) -> str:
    """The reason that a screen reader reads for a control that is off."""
    assert control.is_disabled()
    return str(control.evaluate("(one) => document.getElementById(one.getAttribute('aria-describedby')).textContent"))


# -- lights


BLUE, BLACK = {"b": 1.0, "g": 0.0, "r": 0.0}, {"b": 0.0, "g": 0.0, "r": 0.0}


@pytest.fixture
def dark(opened: Tab, robot: Robot) -> Tab:
    """Its lights are off, whatever the test before left."""
    opened.test("lights-off").click()
    assert opened.until(lambda: robot.asked("lights-solid") == [BLACK])
    robot.received.clear()
    return opened


def test_lights_solid_flashing_and_off(dark: Tab, robot: Robot) -> None:
    def set_period(text: str) -> None:
        dark.test("lights-period").fill(text)
        dark.test("lights-period").press("Enter")

    dark.test("colour-blue").click()
    assert dark.until(lambda: robot.asked("lights-solid") == [BLUE])
    set_period("0.5")
    dark.test("lights-flash").click()
    assert dark.until(lambda: robot.asked("lights-flash") == [BLUE | {"period": 0.5}])
    set_period("1.25")
    assert dark.until(lambda: [one["period"] for one in robot.asked("lights-flash")] == [0.5, 1.25])
    set_period("99")
    assert dark.test("lights-period").input_value() == "1.25"
    dark.test("lights-off").click()
    assert dark.until(lambda: robot.asked("lights-solid")[1:] == [BLACK])
    assert dark.test("lights-off").get_attribute("aria-pressed") == "true"


def test_what_is_being_typed_outlives_what_arrives(dark: Tab, robot: Robot) -> None:
    period = dark.test("lights-period")
    before = period.input_value()
    period.fill("3.5")
    robot.publish_capabilities(CAPABILITIES | {"identity": {"name": "Blinker"}})
    assert dark.until(lambda: "Blinker" in text(dark, "lights-asked"))
    assert period.input_value() == "3.5"
    period.blur()
    assert period.input_value() == "3.5"
    period.fill("0")
    period.blur()
    assert dark.until(lambda: period.input_value() == "3.5")
    period.fill(before)
    period.blur()
    robot.publish_capabilities(CAPABILITIES)


_DRAG = """async (input) => {
  for (let step = 0; step <= 50; step++) {
    input.value = `#${(5 * step).toString(16).padStart(2, "0")}00ff`;
    input.dispatchEvent(new Event("input", { bubbles: true }));
    await new Promise((resolve) => setTimeout(resolve, 10));
  }
}"""


def test_a_dragged_colour_is_sent_now_and_then_and_at_last(dark: Tab, robot: Robot) -> None:
    begun = time.monotonic()
    dark.test("colour").evaluate(_DRAG)
    assert dark.until(
        lambda: (robot.asked("lights-solid") or [{"r": 0}])[-1]["r"] == pytest.approx(250 / 255, abs=0.001)
    )
    times = [at for at, name, _ in robot.received if name.endswith("/lights-solid")]
    assert len(times) <= 2 + (times[-1] - begun) / 0.2


def test_a_browser_remembers_what_it_asked_of_lights(dark: Tab, served: Served, robot: Robot) -> None:
    dark.test("colour-green").click()
    dark.test("lights-flash").click()
    assert dark.until(lambda: robot.asked("lights-flash"))
    with closing(dark.context.new_page()) as page:
        page.goto(f"{served.origin}/r/{BASE}")
        page.locator('[data-test="colour-green"][aria-pressed="true"]').wait_for()
        page.locator('[data-test="lights-flash"][aria-pressed="true"]').wait_for()


# -- sounds


def test_hundreds_of_clips_are_filtered_and_one_is_played(opened: Tab, robot: Robot) -> None:
    assert opened.test("clip").count() == 60
    assert text(opened, "more-clips") == "… 242 more: use the filter."
    assert why(opened.test("repeat-last")) == "Play one sound first"
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
    opened.test("repeat").check()
    robot.show("soundboard-status", QUIET | {"error": "player exited with code 1"})
    assert opened.until(lambda: opened.test("sound-error").count() == 1)
    opened.test("clip").click()
    opened.test("repeat").uncheck()
    opened.test("repeat-last").click()
    assert opened.until(lambda: len(robot.asked("soundboard-command")) == 4)
    assert [one.get("repeat") for one in robot.asked("soundboard-command")[2:]] == [True, True]
    opened.test("stop-sound").click()
    assert opened.until(lambda: robot.asked("soundboard-command")[-1]["action"] == "stop")
    opened.test("sound-filter").fill("")


# -- scripts


def show_script(opened: Tab, file: str) -> None:
    """Open the form of this script."""
    row = opened.test(f"script-{file}")
    if row.get_attribute("aria-expanded") == "false":
        row.click()
    opened.page.locator(f'[data-test="script-{file}"][aria-expanded="true"]').wait_for()


def show_more(opened: Tab) -> None:
    opened.page.evaluate("document.querySelector('.script-more').open = true")


def test_a_form_shows_what_matters_first_and_its_defaults(opened: Tab, robot: Robot) -> None:
    show_script(opened, "april-follow")
    assert SUMMARY in text(opened, "script-april-follow")
    first = opened.page.locator(".scripts > li > form > .ask-form [data-test^=set-]")
    names = [one.get_attribute("data-test") for one in first.all()]
    assert names == ["set-search", "set-tag_id"]  # what the script names, and what has no default
    assert text(opened, "more-settings") == "3 more, all at their defaults"
    show_more(opened)
    name = opened.test("set-name")
    assert name.input_value() == "tag"
    name.fill("other")
    assert opened.until(lambda: text(opened, "more-settings") == "3 more, 1 changed")
    name.fill("")
    assert name.input_value() == ""
    name.blur()  # its default is there again
    assert opened.until(lambda: name.input_value() == "tag")
    assert text(opened, "more-settings") == "3 more, all at their defaults"


def test_a_form_is_sent_when_the_browser_finds_no_mistake(opened: Tab, robot: Robot) -> None:
    def refuses(name: str) -> bool:
        start.click()
        return opened.page.evaluate("document.activeElement.dataset.test") == f"set-{name}"

    show_script(opened, "april-follow")
    start = opened.test("start-script")
    assert opened.until(start.is_enabled)
    assert refuses("tag_id")  # it is required
    tag = opened.test("set-tag_id")
    assert tag.get_attribute("title") == "A whole number from 0 to 34"
    tag.fill("35")
    assert refuses("tag_id")
    tag.fill("7")
    show_more(opened)
    distance = opened.test("set-distance")
    assert distance.input_value() == "0.6"
    distance.press("Control+A")
    distance.press_sequentially("-5")
    opened.page.evaluate("document.querySelector('.script-more').open = false")
    assert refuses("distance")  # what it refuses is in sight
    opened.test("restore-distance").click()
    assert distance.input_value() == "0.6"
    assert robot.asked("autonomy-command") == []
    distance.fill("0.8")
    opened.test("set-search").uncheck()
    opened.test("set-family").select_option("36H11")
    start.click()
    assert opened.until(lambda: robot.asked("autonomy-command"))
    config = {"tag_id": 7, "distance": 0.8, "search": False, "family": "36H11"}
    assert robot.asked("autonomy-command") == [{"action": "start", "file": "april-follow", "config": config}]
    opened.test("set-search").check()
    opened.test("set-family").select_option("25H9")
    opened.test("set-name").fill("other")
    start.click()
    assert opened.until(lambda: len(robot.asked("autonomy-command")) == 2)
    assert robot.asked("autonomy-command")[1]["config"] == {"tag_id": 7, "distance": 0.8, "name": "other"}


def test_a_form_is_remembered_for_its_robot_and_script(opened: Tab, robot: Robot, served: Served) -> None:
    show_script(opened, "april-follow")
    opened.test("set-tag_id").fill("9")
    show_script(opened, "circle")
    assert opened.until(lambda: opened.test("set-tag_id").count() == 0)
    show_script(opened, "april-follow")
    assert opened.test("set-tag_id").input_value() == "9"
    opened.test("restore-all").click()
    assert opened.test("set-tag_id").input_value() == ""
    opened.test("set-tag_id").fill("11")
    with closing(opened.context.new_page()) as page:
        page.goto(f"{served.origin}/r/{BASE}")
        page.locator('[data-test="set-tag_id"]').wait_for()
        assert page.locator('[data-test="set-tag_id"]').input_value() == "11"


def test_what_runs_and_its_end(opened: Tab, robot: Robot) -> None:
    parts = [{"file": "wheel-odometry", "pid": 5, "running": True}, {"file": "locations", "pid": 6, "running": False}]
    robot.show("autonomy-status", running(dependencies=parts))
    assert opened.until(lambda: "april-follow runs, since " in text(opened, "script-state"))
    assert "before" not in text(opened, "script-state")
    opened.test("effective").click()
    shown = opened.page.locator(".effective dl").inner_text().split("\n")
    assert {"0.8", "7"} <= {line.strip() for line in shown}
    lines = opened.page.locator(".dependencies").inner_text().split("\n")
    assert lines == ["● wheel-odometry runs", "✖ locations does not run"]
    robot.show("autonomy-status", running(overridden=True))
    assert opened.until(lambda: "waits: a person drives" in text(opened, "script-state"))
    opened.test("end-script").click()
    assert opened.until(lambda: robot.asked("autonomy-command") == [{"action": "stop"}])
    robot.show("autonomy-status", IDLE | {"error": "april-follow exited with code 1"})
    assert opened.until(lambda: "exited with code 1" in text(opened, "script-error"))
    assert text(opened, "script-state") == "No script runs."


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
    assert text(driver, "stop-script") == "Stop april-follow"
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


def test_no_script_starts_while_a_person_drives(driver: Tab, robot: Robot) -> None:
    show_script(driver, "circle")
    driver.page.evaluate("document.activeElement.blur()")
    assert driver.until(driver.test("start-script").is_enabled)
    driver.page.keyboard.down("KeyW")
    assert driver.until(lambda: moves(robot))
    assert driver.until(driver.test("start-script").is_disabled)
    assert why(driver.test("start-script")) == "You are driving"
    driver.page.keyboard.up("KeyW")
    assert driver.until(driver.test("start-script").is_enabled)


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
