"""Sound between a whole robot and a page in Chromium: what its microphone records, what its loudspeaker plays."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from pebble.contract.packets import Sound
from pebble.extensions.media.pcm import Resampler
from pebble.transports import Message, MqttSettings, create
from tests.ext.page.browser import Size, chromium, tab
from tests.ext.page.ears import (
    PLAIN_MICROPHONE,
    compared,
    fake_microphone,
    is_played,
    listener,
    played,
    recorded,
    state,
    talks,
    write_voice,
)
from tests.ext.page.stage import Stage
from tests.support import until

pytestmark = [pytest.mark.alone, pytest.mark.page]


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


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_a_page_plays_the_robots_sound_and_the_robot_the_voice(goob: Stage, browser: Browser, size: Size) -> None:
    before = len(played(goob))
    voice = lambda: played(goob)[before:]
    with tab(browser, goob.robot_url("goob"), size, script=PLAIN_MICROPHONE) as opened:
        opened.uncover("listen").click()
        opened.uncover("sound-state")
        assert opened.until(lambda: "ms buffered · opus" in state(opened), 20)
        assert is_played(opened, 0.9, envelopes=True)
        assert talks(opened)
        assert opened.until(lambda: len(voice()) > 2 * 48_000, 20)
        assert opened.until(lambda: compared(voice(), 48_000) > 0.9, 20)
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
    """Where the machine stood still, more sound waits; less again within a minute."""
    ears = Ears(goob)
    with tab(browser, goob.robot_url("goob")) as opened, listener(goob.url.rstrip("/"), "pcm"):
        opened.test("listen").click()
        opened.uncover("sound-state")
        assert opened.until(lambda: "ms buffered · pcm" in state(opened), 20)
        opened.page.wait_for_timeout(2000)
        assert is_played(opened, 0.95, envelopes=False)
        assert opened.until(lambda: mouth_to_ear(opened.page, ears.packets) <= 150, 90)
        opened.test("listen").click()
    assert until(lambda: b"false" in ears.flags[-1], 10)
    ears.close()


def mouth_to_ear(page: Page, packets: list[Sound]) -> float:
    """Milliseconds from the capture of some sound to when it was heard: the median of the next four seconds."""
    page.evaluate("() => { recorded.length = recordedAt.length = 0 }")
    packets.clear()
    page.wait_for_timeout(4000)
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
    median = statistics.median(delays) if len(delays) > 3 else math.inf
    print(f"mouth to ear {median:.0f} ms, {len(delays)} of {len(packets) // 25 - 1} pieces found")  # noqa: T201
    return median


def position(part: np.ndarray[Any, Any], whole: np.ndarray[Any, Any]) -> tuple[int, float]:
    """Where ``part`` is in ``whole``, and how alike they are there."""
    size = 1 << (len(part) + len(whole)).bit_length()
    products = np.fft.irfft(np.fft.rfft(whole, size) * np.conj(np.fft.rfft(part, size)), size)
    place = int(np.argmax(products[: len(whole) - len(part)]))
    there = whole[place : place + len(part)]
    return place, float(products[place] / np.sqrt(np.sum(there**2) * np.sum(part**2) + 1e-9))
