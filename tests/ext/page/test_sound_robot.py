"""Sound between a whole robot and a page in Chromium: what its microphone records, what its loudspeaker plays.

Both are recorded, and compared with the speech that was sent.
"""

from __future__ import annotations

import base64
import time
import wave
from collections.abc import Callable, Iterator
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Browser

from pebble.extensions.lab.rig.testbed import LinuxRobot
from pebble.extensions.lab.simulation.loudspeaker import playbacks
from pebble.extensions.media.pcm import Resampler
from pebble.extensions.media.speech import PERIOD_S, Speech
from tests.ext.page.browser import Tab, chromium, tab
from tests.ext.page.stage import Stage
from tests.kit.sound import best_match, envelope
from tests.support import until

pytestmark = [pytest.mark.alone, pytest.mark.page]
RATE = 16_000
SILENT_S = 0.5
_SURE = 0.96  # more than any test needs
#: Records what the page plays.
TAP = """async () => {
  const { node } = pebble.sound.model.speaker;
  window.recorded = [];
  node.port.onmessage = ({ data }) => recorded.push(data.left);
  node.port.postMessage({ taps: true });
}"""
#: Everything that was recorded, as 16 bits.
RECORDED = """() => {
  const samples = Int16Array.from(recorded.flatMap((block) => [...block]), (sample) => 32767 * sample);
  let text = "";
  for (const byte of new Uint8Array(samples.buffer)) text += String.fromCharCode(byte);
  return btoa(text);
}"""
#: A microphone as it is: browsers filter noise, level the voice, and with that change the samples.
PLAIN_MICROPHONE = """const media = navigator.mediaDevices;
const open = media.getUserMedia.bind(media);
media.getUserMedia = () =>
  open({ audio: { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 } });"""


@lru_cache(maxsize=4)
def speech(rate: int, seconds: float = PERIOD_S) -> npt.NDArray[np.float64]:
    """Return the speech of robots and people in tests, at any rate."""
    return at_rate(Speech(RATE).samples(0, int(seconds * RATE)), rate)


def at_rate(samples: npt.NDArray[np.int16], rate: int) -> npt.NDArray[np.float64]:
    """Return 16 kHz, mono, at another rate."""
    if not len(samples):
        return np.zeros(0)
    return Resampler(RATE, rate, 1).feed(samples.reshape(-1, 1))[:, 0].astype(float)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Its microphone records the speech, and every page may use it."""
    voice = tmp_path_factory.mktemp("voice") / "voice.wav"
    with wave.open(str(voice), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48_000)
        file.writeframes(speech(48_000).astype("<i2").tobytes())
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    with chromium(*flags, f"--use-file-for-fake-audio-capture={voice}") as running:
        yield running


@pytest.fixture(scope="module")
def goob() -> Iterator[Stage]:
    with Stage("goob") as running:
        yield running


def state(opened: Tab) -> str:
    return str(opened.test("sound-state").evaluate("(shown) => shown.title || shown.innerText"))


def is_played(opened: Tab, within: float = 20.0) -> bool:
    """True if a second and a half of what the page plays agrees with the speech; a busy machine may take a while."""
    opened.page.evaluate(TAP)
    rate = int(opened.page.evaluate("pebble.sound.model.speaker.context.sampleRate"))
    end = time.monotonic() + within
    while time.monotonic() < end:
        opened.page.evaluate("() => { recorded.length = 0 }")
        assert opened.until(f"recorded.length * 128 > {2.5 * rate}", within)
        sound = np.frombuffer(base64.b64decode(opened.page.evaluate(RECORDED)), "<i2").astype(float)
        if compared(sound, rate, partial(envelope, rate=rate)) > 0.9:
            return True
    return False


def played(stage: Stage) -> npt.NDArray[np.float64]:
    """Return what its loudspeaker has played of a voice, at 48 kHz."""
    robot = stage.robots["goob"]
    assert isinstance(robot, LinuxRobot)
    pcm = b"".join(one.frames() for one in playbacks(robot.voice))
    return at_rate(np.frombuffer(pcm, "<i2"), 48_000)


def compared(sound: npt.NDArray[np.float64], rate: int, form: Callable[..., npt.NDArray[np.float64]]) -> float:
    """Return the highest correlation of a second and a half with the speech, or the first beyond doubt."""
    original = form(speech(rate, 2 * PERIOD_S))
    size, step, best = int(1.5 * rate), rate // 4, 0.0
    for at in range(0, len(sound) - size + 1, step):
        best = max(best, best_match(form(sound[at : at + size]), original))
        if best > _SURE:
            break
    return best


def talks(opened: Tab) -> bool:
    """Hold the button until the server takes the voice; again, if a busy machine has ended the talk, as it should."""
    for _ in range(3):
        assert opened.until(opened.test("talk").is_enabled)
        opened.test("talk").hover()
        opened.page.mouse.down()
        if opened.until(lambda: state(opened).lower() == "goob plays your voice.", 8):
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

    with tab(browser, f"{goob.url}r/{goob.ref('goob')}", script=PLAIN_MICROPHONE) as opened:
        opened.uncover("listen").click()
        opened.uncover("sound-state")
        assert opened.until(lambda: "ms buffered · opus" in state(opened), 20)
        assert is_played(opened)
        assert talks(opened)
        assert opened.page.evaluate("pebble.sound.model.speaker.gain.gain.value") == 0  # else it would come back
        assert opened.until(lambda: len(played(goob)) > 2 * 48_000, 20)
        assert opened.until(lambda: compared(played(goob), 48_000, np.asarray) > 0.9, 20)
        opened.freeze()
        assert until(falls_silent, 6)
        opened.thaw()
        opened.page.mouse.up()
        assert opened.errors + opened.violations == []
