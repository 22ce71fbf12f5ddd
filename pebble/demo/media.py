"""The demo's eyes and ears: looks at every robot and listens to it, in one encoding after another."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from functools import partial

import numpy as np

from pebble.demo.discovery import Sighting
from pebble.demo.media_judge import MediaVerdict, Samples, Shown, judge_pictures, judge_sound
from pebble.demo.robot import CAMERA_FPS
from pebble.errors import PebbleError
from pebble.media.audience import Audience
from pebble.media.decode import Decoded
from pebble.media.scene import read_counter
from pebble.media.sound import Heard
from pebble.media.speech import PERIOD_S as SPEECH_PERIOD_S
from pebble.media.speech import Speech
from pebble.media.viewer import Medium
from pebble.transports import MqttSettings, Transport, create

VIDEO, AUDIO = ("json", "pbvd", "pbvz", "h264"), ("pcm", "opus")
LOOK_S = 4.0  # at each encoding of the pictures
_CHANGE_S = 1.5  # until another encoding has surely come; not judged
ROUND_S = LOOK_S * len(VIDEO)
_LISTEN_S = ROUND_S / len(AUDIO)
_STEP_S = 0.1
_GAP_MS = 15.0  # less than the shortest chunk
_KNOWN_S = 5.0
_PICTURES, _SOUNDS, _VERDICTS = 1000, 5000, 200  # that wait to be judged


class Watched(Audience):
    """One robot as seen and heard: keeps what is to be judged. Filled by the transport's threads, read by others."""

    def __init__(self, transport: Transport, base: str) -> None:
        super().__init__(transport, base)
        self.problem = ""
        self.audio_rate = 0
        self._shown: deque[tuple[str, Shown]] = deque(maxlen=_PICTURES)
        self._stretch: deque[Heard] = deque(maxlen=_SOUNDS)

    def take_shown(self, encoding: str) -> list[Shown]:
        """The pictures of ``encoding`` since the last time."""
        shown, self._shown = self._shown, deque(maxlen=_PICTURES)
        return [one for name, one in list(shown) if name == encoding]

    def take_heard(self, encoding: str) -> Samples:
        """The longest stretch of sound of ``encoding`` since the last time in which nothing is missing; mono."""
        taken, self._stretch = self._stretch, deque(maxlen=_SOUNDS)
        heard = [one for one in list(taken) if one.encoding == encoding]
        stretches: list[list[Samples]] = [[]]
        for before, one in zip([None, *heard], heard, strict=False):
            if before is not None and not _follows(before, one):
                stretches.append([])
            stretches[-1].append(one.samples.mean(axis=1))
        longest = max(stretches, key=len)
        return np.concatenate(longest) if longest else np.zeros(0)

    def on_picture(self, seen: Decoded) -> None:
        captured_s = time.time() if seen.captured_ms is None else seen.captured_ms / 1000
        self._shown.append((seen.encoding, Shown(captured_s, read_counter(seen.picture))))

    def on_sound(self, heard: Heard) -> None:
        self.audio_rate = heard.rate
        self._stretch.append(heard)


def _follows(before: Heard, one: Heard) -> bool:
    """Is it the very next? On a machine that stood still the microphone, too, misses something, and counts on."""
    due_ms = before.captured_ms + 1000 * len(before.samples) / before.rate
    return one.sequence == before.sequence + 1 and abs(one.captured_ms - due_ms) < _GAP_MS


class MediaShow:
    """Goes through the encodings on a thread of its own, over its own connection. ``verdicts`` collects what came."""

    def __init__(self, port: int, name: str = "pebble-demo-viewer") -> None:
        self.watched: dict[str, Watched] = {}
        self.verdicts: deque[MediaVerdict] = deque(maxlen=_VERDICTS)
        self.rounds = 0
        self._transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
        self._robots: Sequence[Sighting] = ()
        self._enough = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def begin(self, robots: Sequence[Sighting]) -> None:
        """Start looking at these and listening to them; returns at once."""
        self._robots = robots
        self._thread.start()

    def end(self) -> None:
        """Ask for nothing any more, and go."""
        self._enough.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._transport.close()

    # -- the show's thread

    def _run(self) -> None:
        self._transport.open()
        self.watched = {robot.name: Watched(self._transport, robot.base) for robot in self._robots}
        for watched in self.watched.values():
            self._try(watched, partial(watched.wait_known, _KNOWN_S))
        sounds = threading.Thread(target=self._turns, args=("audio", AUDIO, _LISTEN_S), daemon=True)
        sounds.start()
        self._turns("video", VIDEO, LOOK_S)
        sounds.join()
        for watched in self.watched.values():
            watched.end()

    def _turns(self, medium: Medium, encodings: Sequence[str], seconds: float) -> None:
        while not self._enough.is_set():
            for encoding in encodings:
                self._ask(medium, encoding)
                if self._wait(_CHANGE_S):
                    return
                self._forget(medium, encoding)
                if self._wait(seconds - _CHANGE_S):
                    return
                self.verdicts.extend(self._judge(medium, name, encoding) for name in self.watched)
            self.rounds += medium == "video"

    def _ask(self, medium: Medium, encoding: str) -> None:
        for watched in self.watched.values():
            self._try(watched, partial(watched.viewer.ask, medium, encoding))

    def _try(self, watched: Watched, act: partial[None]) -> None:
        try:
            act()
        except PebbleError as error:
            watched.problem = str(error)

    def _forget(self, medium: Medium, encoding: str) -> None:
        for watched in self.watched.values():
            if medium == "video":
                watched.take_shown(encoding)
            else:
                watched.take_heard(encoding)

    def _wait(self, seconds: float) -> bool:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for watched in self.watched.values():
                watched.keep_going()
            if self._enough.wait(min(left, _STEP_S)):
                return True
        return False

    def _judge(self, medium: Medium, name: str, encoding: str) -> MediaVerdict:
        watched = self.watched[name]
        said = watched.viewer.capabilities.get(medium, {})
        if watched.problem:
            return MediaVerdict(name, encoding, "", (watched.problem,))
        if medium == "video":
            fps = float(said.get("fps") or 0)
            return judge_pictures(name, encoding, watched.take_shown(encoding), CAMERA_FPS, fps)
        rate = watched.audio_rate or 16_000
        made = Speech(rate).samples(0, 2 * rate * SPEECH_PERIOD_S)[:, 0].astype(float)
        return judge_sound(name, encoding, watched.take_heard(encoding), made, rate)
