"""Sound between a whole robot and a page in Chromium: the page plays its microphone, its loudspeaker the page's."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser

from pebble.extensions.lab.rig.testbed import LinuxRobot
from pebble.extensions.lab.simulation.loudspeaker import playbacks
from tests.ext.page.browser import Tab, chromium, tab
from tests.ext.page.stage import Stage
from tests.support import until

pytestmark = [pytest.mark.alone, pytest.mark.page]
SILENT_S = 0.5
#: Notes the loudest sample that the page plays.
TAP = """() => {
  const { node } = pebble.sound.model.speaker;
  window.loudest = 0;
  node.port.onmessage = ({ data }) => { loudest = data.left.reduce((most, one) => Math.max(most, one), loudest); };
  node.port.postMessage({ taps: true });
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Its microphone hears beeps, and every page may use it."""
    with chromium("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream") as running:
        yield running


@pytest.fixture(scope="module")
def goob() -> Iterator[Stage]:
    with Stage("goob") as running:
        yield running


def state(opened: Tab) -> str:
    return str(opened.test("sound-state").evaluate("(shown) => shown.title || shown.innerText"))


def played(stage: Stage) -> bytes:
    """Return the samples that its loudspeaker has played of a voice."""
    robot = stage.robots["goob"]
    assert isinstance(robot, LinuxRobot)
    return b"".join(one.frames() for one in playbacks(robot.voice))


def talks(opened: Tab) -> bool:
    """Hold the button until the server takes the voice; again, if a busy machine has ended the talk, as it should."""
    for _ in range(3):
        assert opened.until(opened.test("talk").is_enabled)
        opened.test("talk").hover()
        opened.page.mouse.down()
        if opened.until(lambda: state(opened).lower() == "goob plays your voice."):
            return True
        opened.page.mouse.up()
        opened.page.wait_for_timeout(200)
    return False


def test_a_page_plays_the_robots_sound_and_the_robot_the_voice_until_the_page_stands_still(
    goob: Stage, browser: Browser
) -> None:
    def falls_silent() -> bool:
        before = len(played(goob))
        time.sleep(SILENT_S)  # not the page's wait: it is frozen
        return len(played(goob)) == before

    with tab(browser, f"{goob.url}r/{goob.ref('goob')}") as opened:
        opened.uncover("listen").click()
        opened.uncover("sound-state")
        assert opened.until(lambda: "ms buffered · opus" in state(opened))
        opened.page.evaluate(TAP)
        assert opened.until("loudest > 0.02")
        assert talks(opened)
        assert opened.until("pebble.sound.model.speaker.gain.gain.value === 0")  # else it would come back
        assert opened.until(lambda: np.abs(np.frombuffer(played(goob), "<i2").astype(int)).max(initial=0) > 1000)
        opened.freeze()
        assert until(falls_silent)
        opened.thaw()
        opened.page.mouse.up()
        assert opened.errors + opened.violations == []
