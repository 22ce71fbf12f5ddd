"""Sound between a robot and a page in Chromium, through the real server and a real broker."""

from __future__ import annotations

import base64
import time
import wave
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from pebble.demo.media_assessment import best_match, envelope
from pebble.media.pcm import Resampler
from pebble.media.speech import PERIOD_S, Speech
from pebble.transports import MqttSettings, create
from tests.support import Broker
from tests.web.browser import Size, Tab, chromium, tab
from tests.web.served import Served
from tests.web.sound_robot import REF, SoundRobot
from tests.web.stage import Stage

RATE = 16_000
#: Records what the page plays; as a worklet hands it over.
TAP = """async () => {
  const { node } = await pebble.sound.model.speaker;
  window.heard = [];
  window.heardAt = []; // seconds of the sound's clock
  node.port.onmessage = ({ data }) => heardAt.push(data.at) && heard.push(data.left);
  node.port.postMessage({ taps: true });
}"""
#: Everything that was recorded, as 16 bits.
HEARD = """() => {
  const samples = Int16Array.from(heard.flatMap((block) => [...block]), (sample) => 32767 * sample);
  let text = "";
  for (const byte of new Uint8Array(samples.buffer)) text += String.fromCharCode(byte);
  return btoa(text);
}"""


def speech(seconds: float, rate: int = RATE) -> np.ndarray[Any, np.dtype[np.float64]]:
    return Speech(rate).samples(0, int(seconds * rate))[:, 0].astype(float)


@pytest.fixture(scope="module")
def voice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the browser's microphone records, again and again."""
    path = tmp_path_factory.mktemp("voice") / "voice.wav"
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48_000)
        file.writeframes(speech(PERIOD_S, 48_000).astype("<i2").tobytes())
    return path


def fake_microphone(voice: Path) -> tuple[str, ...]:
    """Flags of a browser whose microphone records this file, and that lets every page use it."""
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    return *flags, f"--use-file-for-fake-audio-capture={voice}"


@pytest.fixture(scope="module")
def browser(voice: Path) -> Iterator[Browser]:
    with chromium(*fake_microphone(voice)) as running:
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


@contextmanager
def listener(served: Served | Stage, can: str) -> Iterator[ClientConnection]:
    """Another page that listens."""
    origin = served.origin if isinstance(served, Served) else served.url.rstrip("/")
    url = f"{origin.replace('http', 'ws')}/ws/sound?ref={REF}&can={can}"
    with connect(url, origin=Origin(origin), max_size=None) as socket:
        yield socket


def state(opened: Tab) -> str:
    return str(opened.test("sound-state").inner_text())


def likeness(opened: Tab, seconds: float, *, envelopes: bool) -> float:
    """How well the best second and a half of what the page plays from now on agrees with what the robot said."""
    opened.page.evaluate(TAP)
    rate = int(opened.page.evaluate("pebble.sound.model.context.sampleRate"))
    assert opened.until(f"heard.length * 128 > {seconds * rate}", seconds + 10)
    heard = np.frombuffer(base64.b64decode(opened.page.evaluate(HEARD)), "<i2").astype(float)
    return compared(heard, rate, envelopes=envelopes)


def compared(heard: np.ndarray[Any, Any], rate: int, *, envelopes: bool = False) -> float:
    said = Resampler(RATE, rate, 1).feed(Speech(RATE).samples(0, 2 * PERIOD_S * RATE))[:, 0].astype(float)
    size, step = int(1.5 * rate), rate // 4
    windows = [heard[at : at + size] for at in range(0, len(heard) - size + 1, step)]
    if envelopes:
        return max(best_match(envelope(one, rate), envelope(said, rate)) for one in windows)
    return max(best_match(one, said) for one in windows)


def test_what_the_robot_says_is_heard(browser: Browser, served: Served, robot: SoundRobot):
    with page_of(browser, served) as opened, listener(served, "pcm"):
        assert state(opened) == ""
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · pcm" in state(opened))
        assert likeness(opened, 3, envelopes=False) > 0.95
        assert robot.encodings[0] in ("opus", "pcm")
        opened.test("mute").click()
        assert opened.until(lambda: state(opened).startswith("muted"))
        assert opened.page.evaluate("pebble.sound.model.gain.gain.value") == 0
        opened.test("listen").click()
        assert opened.until(lambda: state(opened) == "")
        assert opened.complaints() == []


def test_opus_is_heard(browser: Browser, served: Served, robot: SoundRobot):
    with page_of(browser, served, "phone") as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered · opus" in state(opened))
        assert likeness(opened, 3, envelopes=True) > 0.9
        assert opened.complaints() == []


WITHOUT_WORKLET = """Object.defineProperty(BaseAudioContext.prototype, "audioWorklet", { get: () => undefined });
Object.defineProperty(navigator, "mediaDevices", { get: () => undefined });"""


def test_over_plain_http_sound_is_heard_and_talking_needs_https(browser: Browser, served: Served, robot: SoundRobot):
    """As far as the page can tell; the worker still decodes Opus."""
    with page_of(browser, served, script=WITHOUT_WORKLET) as opened:
        assert opened.test("talk").is_disabled()
        why = opened.test("talk").get_attribute("aria-describedby")
        assert opened.page.locator(f"#{why}").inner_text() == "Needs https"
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered" in state(opened))
        assert opened.until("pebble.sound.model.stats.received > 100")


# -- talking


def talks(opened: Tab) -> bool:
    """Hold the button until the server takes the voice."""
    opened.test("talk").hover()
    opened.page.mouse.down()
    return opened.until(lambda: state(opened) == "goob plays your voice.")


def test_a_voice_is_heard_at_the_robot(browser: Browser, served: Served, robot: SoundRobot):
    with page_of(browser, served) as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered" in state(opened))
        assert talks(opened)
        assert opened.page.evaluate("pebble.sound.model.gain.gain.value") == 0  # else it would come back
        assert opened.until(lambda: len(robot.heard) > 150)
        opened.page.mouse.up()
        assert opened.until(lambda: "ms buffered" in state(opened))
        heard = np.frombuffer(b"".join(packet.body for packet in robot.heard), "<i2").astype(float)
        loud = Resampler(RATE, 48_000, 1).feed(heard.astype(np.int16)[:, None])[:, 0].astype(float)
        assert compared(loud, 48_000) > 0.9
        assert opened.page.evaluate("pebble.sound.model.gain.gain.value") == 1
        assert opened.complaints() == []


INTERRUPTIONS = {
    "released": lambda opened: opened.page.mouse.up(),
    "blur": lambda opened: opened.blur(),
    "hidden": lambda opened: opened.hide(),
    "menu": lambda opened: opened.page.evaluate("document.body.dispatchEvent(new Event('contextmenu', {bubbles: true}))"),
    "dialog": lambda opened: opened.page.evaluate(
        "() => { const one = document.createElement('dialog'); document.body.append(one); one.show(); }"
    ),
    "pointer": lambda opened: opened.page.evaluate(
        """() => document.querySelector('[data-test=talk]').dispatchEvent(new PointerEvent('lostpointercapture'))"""
    ),
    "frozen": lambda opened: opened.freeze(),
    "elsewhere": lambda opened: opened.page.evaluate("pebble.route.go('')"),
}


@pytest.mark.parametrize("how", INTERRUPTIONS)
def test_what_ends_a_gesture_ends_a_talk(browser: Browser, served: Served, robot: SoundRobot, how: str):
    with page_of(browser, served) as opened:
        assert talks(opened)
        assert opened.until(lambda: len(robot.heard) > 5)
        INTERRUPTIONS[how](opened)
        assert falls_silent(opened, robot)


def falls_silent(opened: Tab, robot: SoundRobot) -> bool:
    """Whether soon no voice reaches the robot any more, for 0.3 s."""
    end = time.monotonic() + 4
    while time.monotonic() < end:
        count = len(robot.heard)
        time.sleep(0.3)  # not the page's wait: one that is frozen would not answer
        if len(robot.heard) == count:
            return True
    return False


def test_while_another_person_talks_the_button_says_who(browser: Browser, served: Served, robot: SoundRobot):
    with page_of(browser, served) as first, page_of(browser, served) as second:
        assert talks(first)
        assert second.until(lambda: second.test("talk").is_disabled())
        assert second.page.locator("#why-talk").inner_text() == "local is talking"
        first.page.mouse.up()
        assert second.until(lambda: second.test("talk").is_enabled())


def test_listening_ends_when_the_page_leaves_the_robot(browser: Browser, served: Served, robot: SoundRobot):
    with page_of(browser, served) as opened:
        opened.test("listen").click()
        assert opened.until(lambda: "ms buffered" in state(opened))
        opened.page.evaluate("pebble.route.go('')")
        assert opened.until("!pebble.sound.model.worker && !pebble.sound.model.listening")
        assert opened.until(lambda: robot.encodings[-1] is None, 8)
        assert opened.until(lambda: robot.flags[-1] is False)
