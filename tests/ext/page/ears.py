"""What a page plays, and its microphone, in Chromium: recorded, and compared with the speech that was sent."""

from __future__ import annotations

import base64
import threading
import time
import wave
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from websockets.sync.client import connect
from websockets.typing import Origin

from pebble.extensions.lab.rig.testbed import LinuxRobot
from pebble.extensions.lab.simulation.loudspeaker import playbacks
from pebble.extensions.media.pcm import Resampler
from pebble.extensions.media.speech import PERIOD_S, Speech
from tests.ext.page.browser import Tab
from tests.ext.page.media.robots import REF
from tests.ext.page.stage import Stage
from tests.kit.sound import best_match, envelope

RATE = 16_000
_SURE = 0.96  # more than any test needs
#: Records what the page plays; as a worklet hands it over.
TAP = """async () => {
  const { node } = pebble.sound.model.speaker;
  window.recorded = [];
  window.recordedAt = []; // seconds of the sound's clock
  node.port.onmessage = ({ data }) => recordedAt.push(data.at) && recorded.push(data.left);
  node.port.postMessage({ taps: true });
}"""
#: Everything that was recorded, as 16 bits.
RECORDED = """() => {
  const samples = Int16Array.from(recorded.flatMap((block) => [...block]), (sample) => 32767 * sample);
  let text = "";
  for (const byte of new Uint8Array(samples.buffer)) text += String.fromCharCode(byte);
  return btoa(text);
}"""


@lru_cache(maxsize=4)
def speech(rate: int, seconds: float = PERIOD_S) -> npt.NDArray[np.float64]:
    """The speech of robots and people in tests, at any rate."""
    return at_rate(Speech(RATE).samples(0, int(seconds * RATE)), rate)


def at_rate(samples: npt.NDArray[np.int16], rate: int) -> npt.NDArray[np.float64]:
    """16 kHz, mono, at another rate."""
    if not len(samples):
        return np.zeros(0)
    return Resampler(RATE, rate, 1).feed(samples.reshape(-1, 1))[:, 0].astype(float)


def write_voice(path: Path) -> None:
    """A WAV file of ``speech``."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48_000)
        file.writeframes(speech(48_000).astype("<i2").tobytes())


#: A microphone as it is: browsers filter noise, level the voice, and with that change the samples.
PLAIN_MICROPHONE = """const media = navigator.mediaDevices;
const open = media.getUserMedia.bind(media);
media.getUserMedia = () =>
  open({ audio: { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 } });"""


def fake_microphone(voice: Path) -> tuple[str, ...]:
    """Flags of a browser whose microphone records this file, and that lets every page use it."""
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    return *flags, f"--use-file-for-fake-audio-capture={voice}"


@contextmanager
def listener(origin: str, can: str) -> Iterator[None]:
    """Another page that listens."""
    url = f"{origin.replace('http', 'ws')}/ws/sound?ref={REF}&can={can}"
    with connect(url, origin=Origin(origin), max_size=None) as socket:
        reading = threading.Thread(target=deque, args=(socket, 0), name="listener")  # who reads nothing is sent no more
        reading.start()
        yield
    reading.join()


def state(opened: Tab) -> str:
    return str(opened.test("sound-state").evaluate("(shown) => shown.title || shown.innerText"))


def is_played(opened: Tab, needed: float, *, envelopes: bool, within: float = 20.0) -> bool:
    """Whether a second and a half of what the page plays agrees with the speech; a busy machine may take a while."""
    opened.page.evaluate(TAP)
    rate = int(opened.page.evaluate("pebble.sound.model.context.sampleRate"))
    end = time.monotonic() + within
    while time.monotonic() < end:
        opened.page.evaluate("() => { recorded.length = recordedAt.length = 0 }")
        assert opened.until(f"recorded.length * 128 > {2.5 * rate}", within)
        found = compared(recorded(opened.page), rate, envelopes=envelopes)
        if found > needed:
            return True
        print(f"the page plays what correlates by {found:.3f}: {state(opened)}")  # noqa: T201
    return False


def recorded(page: Any) -> npt.NDArray[np.float64]:
    """What was played since ``TAP``, at the rate of the page's sound."""
    return np.frombuffer(base64.b64decode(page.evaluate(RECORDED)), "<i2").astype(float)


def played(stage: Stage) -> npt.NDArray[np.float64]:
    """What its loudspeaker has played of a voice, at 48 kHz."""
    robot = stage.robots["goob"]
    assert isinstance(robot, LinuxRobot)
    pcm = b"".join(one.frames() for one in playbacks(robot.voice))
    return at_rate(np.frombuffer(pcm, "<i2"), 48_000)


def compared(played: npt.NDArray[np.float64], rate: int, *, envelopes: bool = False) -> float:
    """The highest correlation of a second and a half of ``played`` with the speech, or the first beyond doubt."""
    form: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]] = (
        partial(envelope, rate=rate) if envelopes else np.asarray
    )
    original = form(speech(rate, 2 * PERIOD_S))
    size, step, best = int(1.5 * rate), rate // 4, 0.0
    for at in range(0, len(played) - size + 1, step):
        best = max(best, best_match(form(played[at : at + size]), original))
        if best > _SURE:
            break
    return best


def talks(opened: Tab) -> bool:
    """Hold the button until the server takes the voice; again, if a busy machine has ended the talk, as it should."""
    for _ in range(3):
        assert opened.until(opened.test("talk").is_enabled)  # the talk of another page may not be over yet
        opened.test("talk").hover()
        opened.page.mouse.down()
        if opened.until(lambda: state(opened).lower() == "goob plays your voice.", 8):
            return True
        print(f"no talk: {state(opened)}")  # noqa: T201
        opened.page.mouse.up()
        opened.page.wait_for_timeout(200)
    return False
