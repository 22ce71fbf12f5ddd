"""Sound between a robot and a page in Chromium, through the real server and a real broker."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser

from pebble.transports import MqttSettings, create
from tests.ext.page.browser import Size, Tab, chromium, tab
from tests.ext.page.ears import (
    PLAIN_MICROPHONE,
    at_rate,
    compared,
    fake_microphone,
    is_played,
    listener,
    state,
    talks,
    write_voice,
)
from tests.ext.page.media.robots import REF, SoundRobot
from tests.ext.page.served import Served
from tests.support import Broker

pytestmark = pytest.mark.page


@pytest.fixture(scope="module")
def browser(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    voice = tmp_path_factory.mktemp("voice") / "voice.wav"
    write_voice(voice)
    with chromium(*fake_microphone(voice), beside=browser) as running:
        yield running


@pytest.fixture
def robot(broker: Broker) -> Iterator[SoundRobot]:
    transport = create("mqtt", "sound", MqttSettings(host="127.0.0.1", port=broker.port))
    robot = SoundRobot(transport=transport.open())
    yield robot
    robot.close()


@contextmanager
def page_of(
    browser: Browser, served: Served, size: Size = "desktop", *, script: str = "", **options: Any
) -> Iterator[Tab]:
    with tab(browser, f"{served.origin}/r/{REF}", size, script=script, **options) as opened:
        if size == "phone":
            opened.test("tab-sound").click()
        opened.test("listen").wait_for()
        yield opened


def test_the_robots_sound_is_played(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served) as opened, listener(served.origin, "pcm"):
        assert state(opened) == ""
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · pcm" in state(opened))
        assert is_played(opened, 0.95, envelopes=False)
        assert robot.encodings[0] in ("opus", "pcm")
        opened.test("mute").click()
        assert opened.until(lambda: state(opened).startswith("muted"))
        assert opened.page.evaluate("pebble.sound.model.speaker.gain.gain.value") == 0
        opened.test("listen").click()
        assert opened.until(lambda: state(opened) == "")
        assert opened.errors + opened.violations == []


def test_opus_is_played(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served, "phone") as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · opus" in state(opened))
        assert is_played(opened, 0.9, envelopes=True)
        assert opened.errors + opened.violations == []


WITHOUT_WORKLET = """delete window.AudioWorkletNode;
Object.defineProperty(navigator, "mediaDevices", { get: () => undefined });"""


def test_over_plain_http_listening_and_talking_say_that_they_need_https(browser: Browser, served: Served) -> None:
    with page_of(browser, served, script=WITHOUT_WORKLET) as opened:
        for name in ("listen", "talk"):
            assert opened.test(name).is_disabled()
            why = opened.test(name).get_attribute("aria-describedby")
            assert opened.page.locator(f"#{why}").inner_text() == "Needs https"


# -- talking


def _has(robot: SoundRobot, count: int) -> bool:
    return len(robot.voice) > count


def plays_voice(opened: Tab, robot: SoundRobot, *, envelopes: bool) -> bool:
    """Whether a second and a half of what has reached the robot agrees with the speech, within ten."""
    for count in (100, 250, 500):
        assert opened.until(partial(_has, robot, count), 20)
        voice = np.frombuffer(b"".join(packet.body for packet in robot.voice), "<i2")
        found = compared(at_rate(voice, 48_000), 48_000, envelopes=envelopes)
        if found > 0.9:
            return True
        print(f"{count} packets correlate by {found:.3f}")  # noqa: T201
    return False


def test_a_voice_reaches_the_robot(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served, script=PLAIN_MICROPHONE) as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered" in state(opened))
        assert talks(opened)
        assert opened.page.evaluate("pebble.sound.model.speaker.gain.gain.value") == 0  # else it would come back
        assert plays_voice(opened, robot, envelopes=False)
        opened.page.mouse.up()
        assert opened.until(lambda: "ms buffered" in state(opened))
        assert opened.page.evaluate("pebble.sound.model.speaker.gain.gain.value") == 1
        assert opened.errors + opened.violations == []


def test_a_voice_that_the_browser_filters_reaches_the_robot(
    browser: Browser, served: Served, robot: SoundRobot
) -> None:
    with page_of(browser, served) as opened:
        assert talks(opened)
        assert plays_voice(opened, robot, envelopes=True)
        opened.page.mouse.up()


INTERRUPTIONS: dict[str, Callable[[Tab], Any]] = {
    "released": lambda opened: opened.page.mouse.up(),
    "blur": lambda opened: opened.blur(),
    "hidden": lambda opened: opened.hide(),
    "menu": lambda opened: opened.page.evaluate(
        "document.body.dispatchEvent(new Event('contextmenu', {bubbles: true}))"
    ),
    "dialog": lambda opened: opened.page.evaluate(
        "() => { const one = document.createElement('dialog'); document.body.append(one); one.show(); }"
    ),
    "pointer": lambda opened: opened.page.evaluate(
        """() => document.querySelector('[data-test=talk]').dispatchEvent(new PointerEvent('lostpointercapture'))"""
    ),
}
UNDONE: dict[str, Callable[[Tab], Any]] = {
    "hidden": lambda opened: opened.hide(hidden=False),
    "dialog": lambda opened: opened.page.evaluate("document.querySelector('dialog[open]').remove()"),
}


def test_what_ends_a_gesture_ends_a_talk(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served) as opened:
        for how, interrupt in INTERRUPTIONS.items():
            robot.voice.clear()
            assert talks(opened), how
            assert opened.until(partial(_has, robot, 5)), how
            interrupt(opened)
            assert falls_silent(opened, robot), how
            UNDONE.get(how, bool)(opened)
            opened.page.mouse.up()


GONE: dict[str, Callable[[Tab], Any]] = {
    "frozen": lambda opened: opened.freeze(),
    "elsewhere": lambda opened: opened.page.evaluate("pebble.route.go('')"),
}


@pytest.mark.parametrize("how", GONE)
def test_a_talk_ends_with_its_screen(browser: Browser, served: Served, robot: SoundRobot, how: str) -> None:
    with page_of(browser, served) as opened:
        assert talks(opened)
        assert opened.until(lambda: len(robot.voice) > 5)
        GONE[how](opened)
        assert falls_silent(opened, robot)


def falls_silent(opened: Tab, robot: SoundRobot) -> bool:
    """Whether soon no voice reaches the robot any more, for 0.3 s."""
    end = time.monotonic() + 4
    while time.monotonic() < end:
        count = len(robot.voice)
        time.sleep(0.3)  # not the page's wait: one that is frozen would not answer
        if len(robot.voice) == count:
            return True
    return False


def test_while_another_person_talks_the_button_shows_who(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served) as first, page_of(browser, served) as second:
        assert talks(first)
        assert second.until(lambda: second.test("talk").is_disabled())
        assert second.page.locator("#why-talk").inner_text() == "local is talking"
        first.page.mouse.up()
        assert second.until(lambda: second.test("talk").is_enabled())


def test_listening_ends_when_the_page_leaves_the_robot(browser: Browser, served: Served, robot: SoundRobot) -> None:
    with page_of(browser, served) as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered" in state(opened))
        opened.page.evaluate("pebble.route.go('')")
        assert opened.until("!pebble.sound.model.worker && !pebble.sound.model.listening")
        assert opened.until(lambda: robot.encodings[-1] is None, 8)
        assert opened.until(lambda: robot.flags[-1] is False)
