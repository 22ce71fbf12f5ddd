"""Sound between a whole robot and a page in Chromium: what its microphone records, what its loudspeaker plays."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.namespaces import obstacle
from pebble.bench.page_links import linked
from pebble.bench.page_rig import Rig
from pebble.contract.packets import Sound
from pebble.demo.testbed import LinuxRobot
from pebble.media.pcm import Resampler
from pebble.simulation.loudspeaker import playbacks
from pebble.transports import Message, MqttSettings, create
from tests.support import until
from tests.web.browser import chromium, tab
from tests.web.ears import (
    PLAIN_MICROPHONE,
    TAP,
    at_rate,
    compared,
    fake_microphone,
    is_played,
    listener,
    recorded,
    state,
    talks,
    write_voice,
)
from tests.web.stage import Stage

pytestmark = pytest.mark.alone


@pytest.fixture(scope="module")
def voice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("voice") / "voice.wav"
    write_voice(path)
    return path


@pytest.fixture(scope="module")
def browser(voice: Path) -> Iterator[Browser]:
    with chromium(*fake_microphone(voice)) as running:
        yield running


@pytest.fixture(scope="module")
def goob() -> Iterator[Stage]:
    with Stage("goob", room=False) as running:
        yield running


def played(stage: Stage) -> np.ndarray[Any, Any]:
    """What its loudspeaker has played of a voice, at 48 kHz."""
    robot = stage.robots["goob"]
    assert isinstance(robot, LinuxRobot)
    pcm = b"".join(one.frames() for one in playbacks(robot.voice))
    return at_rate(np.frombuffer(pcm, "<i2"), 48_000)


def test_a_page_plays_the_robots_sound_and_the_robot_the_voice(goob: Stage, browser: Browser) -> None:
    with tab(browser, goob.robot_url("goob"), script=PLAIN_MICROPHONE) as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · opus" in state(opened), 20)
        assert is_played(opened, 0.9, envelopes=True)
        assert talks(opened)
        assert opened.until(lambda: len(played(goob)) > 2 * 48_000, 20)
        assert opened.until(lambda: compared(played(goob), 48_000) > 0.9, 20)
        opened.page.mouse.up()
        assert opened.errors + opened.violations == []


class Ears:
    """The packets of one robot as the broker delivers them."""

    def __init__(self, stage: Stage) -> None:
        self.packets: list[Sound] = []
        self.flags: list[bytes] = []
        self._transport = create("mqtt", "ears", MqttSettings(host="127.0.0.1", port=stage.broker_port))
        self._transport.open()
        self._transport.subscribe(f"{stage.ref('goob')}/outgoing/audio", self._take)
        self._transport.subscribe(f"{stage.ref('goob')}/incoming/flags/mqtt-audio", self._flag)

    def _take(self, message: Message) -> None:
        self.packets.append(Sound.unpack(message.payload))

    def _flag(self, message: Message) -> None:
        self.flags.append(message.payload)

    def close(self) -> None:
        self._transport.close()


#: When which sample is heard: time of the sound's clock, and epoch milliseconds.
TIMES = """() => {
  const { contextTime, performanceTime } = pebble.sound.model.context.getOutputTimestamp();
  return { contextTime, at: performance.timeOrigin + performanceTime };
}"""


@pytest.mark.thorough
def test_mouth_to_ear_is_short_and_the_flag_is_down_afterwards(goob: Stage, browser: Browser) -> None:
    ears = Ears(goob)
    with tab(browser, goob.robot_url("goob")) as opened, listener(goob.url.rstrip("/"), "pcm"):
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · pcm" in state(opened), 20)
        opened.page.wait_for_timeout(2000)
        assert is_played(opened, 0.95, envelopes=False)
        ears.packets.clear()
        opened.page.wait_for_timeout(4000)
        delays = mouth_to_ear(opened.page, ears.packets)
        assert statistics.median(delays) <= 150, delays
        opened.test("listen").click()
    assert until(lambda: b"false" in ears.flags[-1], 10)
    ears.close()


def mouth_to_ear(page: Page, packets: list[Sound]) -> list[float]:
    """Milliseconds from the capture of each half second to when it was heard."""
    rate = int(page.evaluate("pebble.sound.model.context.sampleRate"))
    whole = recorded(page)
    first_s = float(page.evaluate("recordedAt[0]"))
    now: dict[str, float] = page.evaluate(TIMES)
    delays = []
    for index in range(0, len(packets) - 25, 25):
        some = packets[index : index + 25]
        pcm = np.frombuffer(b"".join(one.body for one in some), "<i2")[:, None]
        part = Resampler(some[0].rate, rate, 1).feed(pcm)[:, 0].astype(float)
        place, found = position(part, whole)
        if found > 0.95:
            at = now["at"] + 1000 * (first_s + place / rate - now["contextTime"])
            delays.append(at - some[0].captured_ms)
    assert len(delays) > 3
    return delays


def position(part: np.ndarray[Any, Any], whole: np.ndarray[Any, Any]) -> tuple[int, float]:
    """Where ``part`` is in ``whole``, and how alike they are there."""
    size = 1 << (len(part) + len(whole)).bit_length()
    products = np.fft.irfft(np.fft.rfft(whole, size) * np.conj(np.fft.rfft(part, size)), size)
    place = int(np.argmax(products[: len(whole) - len(part)]))
    there = whole[place : place + len(part)]
    return place, float(products[place] / np.sqrt(np.sum(there**2) * np.sum(part**2) + 1e-9))


# -- through a slow and lossy network

THIN = Condition("256 kbit/s, 2 %", up=Shape(kbit=256, loss=0.02), down=Shape(loss=0.02))


@pytest.fixture
def far(voice: Path) -> Iterator[Rig]:
    if reason := obstacle():
        pytest.skip(f"no namespaces: {reason}")
    with linked(THIN, "goob", flags=fake_microphone(voice)) as rig:
        yield rig


@pytest.mark.thorough
def test_sound_through_a_slow_and_lossy_network(far: Rig) -> None:
    page = far.page("goob")
    far.until(page, lambda: page.locator("[data-test=listen]:enabled").count(), "no page", 30)
    page.locator("[data-test=video]").click()  # pictures would need all of it
    page.locator("[data-test=listen]").click()
    shown = page.locator("[data-test=sound-state]")
    far.until(page, lambda: "ms buffered · opus" in shown.inner_text(), lambda: shown.inner_text(), 30)
    far.pause(page, 3)
    page.evaluate(TAP)
    far.pause(page, 8)
    rate = int(page.evaluate("pebble.sound.model.context.sampleRate"))
    assert compared(recorded(page), rate, envelopes=True) > 0.9
    page.evaluate(f"() => {{ {PLAIN_MICROPHONE} }}")
    page.locator("[data-test=talk]").hover()
    page.mouse.down()
    far.until(page, lambda: len(played(far.stage)) > 5 * 48_000, lambda: shown.inner_text(), 40)
    page.mouse.up()
    assert compared(played(far.stage), 48_000) > 0.9
