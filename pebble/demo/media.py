"""Receives every robot's pictures and sound in one encoding after another, and assesses them.

A robot has one encoding for everybody: while a person watches or listens to it, it is left as that person chose.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial

import numpy as np

from pebble.client.media_receiver import MediaReceiver
from pebble.client.robot_view import RobotView
from pebble.client.viewer import Medium
from pebble.contract import AUDIO_CONTROL, VIDEO_CONTROL, Channel, codec
from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.demo.media_assessment import (
    MediaResult,
    Samples,
    ShownPicture,
    assess_pictures,
    assess_rate,
    assess_sound,
    watched,
)
from pebble.errors import PayloadError, PebbleError
from pebble.media.decode import Decoded
from pebble.media.scene import read_counter
from pebble.media.sound import ReceivedSound
from pebble.media.speech import PERIOD_S as SPEECH_PERIOD_S
from pebble.media.speech import Speech
from pebble.rig.testbed import CAMERA_FPS
from pebble.transports import Message, MqttSettings, Transport, create

VIDEO_TURN_S = 4.0  # for each encoding of the pictures
_SWITCH_S = 1.5  # until the next encoding has certainly arrived; not assessed
ROUND_S = VIDEO_TURN_S * len(ALL_VIDEO)
_AUDIO_TURN_S = ROUND_S / len(ALL_SOUND)
_STEP_S = 0.1
_GAP_MS = 15.0  # less than the shortest chunk
_CAPABILITIES_TIMEOUT_S = 5.0
_NAME = "pebble-demo-viewer"
_PICTURES, _SOUNDS, _RESULTS = 1000, 5000, 200  # upper limits of what is stored
_CONTROLS: dict[Medium, Channel] = {"video": VIDEO_CONTROL, "audio": AUDIO_CONTROL}


class MediaRecorder(MediaReceiver):
    """Stores one robot's pictures and sound for assessment. The transport's threads write, another one reads."""

    def __init__(self, transport: Transport, base: str) -> None:
        super().__init__(transport, base)
        self.problem = ""
        self.audio_rate = 0
        self.watched: set[Medium] = set()  # that others have requested
        self.disturbed: set[Medium] = set()  # that others requested, or let go, since the last turn began
        self._shown: deque[tuple[str, ShownPicture]] = deque(maxlen=_PICTURES)
        self._stretch: deque[ReceivedSound] = deque(maxlen=_SOUNDS)

    def watch_requests(self) -> None:
        """Notice the requests of others from now on; to be called once the capabilities are known."""
        for medium, channel in _CONTROLS.items():
            topic = self.viewer.topic(medium, "command_topic", channel)
            self._transport.subscribe(topic, partial(self._requested, medium, channel))

    def _requested(self, medium: Medium, channel: Channel, message: Message) -> None:
        if message.payload in self.viewer.sent:
            self.viewer.sent.remove(message.payload)
            return
        try:
            request = codec.decode(channel, message.payload)
        except PayloadError:
            return
        self.disturbed.add(medium)
        if request.enabled:
            self.watched.add(medium)
            self.viewer.hand_over(medium)
        else:
            self.watched.discard(medium)

    def take_pictures(self, encoding: str) -> list[ShownPicture]:
        """The pictures of ``encoding`` since the last call."""
        shown, self._shown = self._shown, deque(maxlen=_PICTURES)
        return [one for name, one in list(shown) if name == encoding]

    def take_sound(self, encoding: str) -> Samples:
        """The longest gapless stretch of sound of ``encoding`` since the last call, as mono samples."""
        taken, self._stretch = self._stretch, deque(maxlen=_SOUNDS)
        received = [one for one in list(taken) if one.encoding == encoding]
        stretches: list[list[Samples]] = [[]]
        for before, one in zip([None, *received], received, strict=False):
            if before is not None and not _follows(before, one):
                stretches.append([])
            stretches[-1].append(one.samples.mean(axis=1))
        longest = max(stretches, key=len)
        return np.concatenate(longest) if longest else np.zeros(0)

    def on_picture(self, seen: Decoded) -> None:
        captured_s = time.time() if seen.captured_ms is None else seen.captured_ms / 1000
        self._shown.append((seen.encoding, ShownPicture(captured_s, read_counter(seen.picture))))

    def on_sound(self, received: ReceivedSound) -> None:
        self.audio_rate = received.rate
        self._stretch.append(received)


def _follows(before: ReceivedSound, one: ReceivedSound) -> bool:
    """Is ``one`` the very next packet? On a machine that stalls, the microphone loses samples but numbers on."""
    due_ms = before.captured_ms + 1000 * len(before.samples) / before.rate
    return one.sequence == before.sequence + 1 and abs(one.captured_ms - due_ms) < _GAP_MS


class MediaCheck:
    """Requests one encoding after another, on its own threads and connection; ``results`` collects the assessments.

    The pictures of the robots ``counting`` have a counter in them. ``overloaded(began, ended)`` says whether the
    machine could not keep up between these times (monotonic), and why.
    """

    def __init__(self, port: int, counting: Collection[str], overloaded: Callable[[float, float], str]) -> None:
        self._counting, self._overloaded = counting, overloaded
        self.recorders: dict[str, MediaRecorder] = {}
        self.results: deque[MediaResult] = deque(maxlen=_RESULTS)
        self.rounds = 0
        self._transport = create("mqtt", _NAME, MqttSettings(host="127.0.0.1", port=port))
        self._robots: Sequence[RobotView] = ()
        self._once = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=_NAME, daemon=True)

    def begin(self, robots: Sequence[RobotView], *, once: bool = False) -> None:
        """Start requesting media from these robots, one round after another or ``once``; returns at once."""
        self._robots, self._once = robots, once
        self._thread.start()

    def end(self) -> None:
        """Withdraw the requests and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._transport.close()

    # -- the threads of the check, one per medium

    def _run(self) -> None:
        self._transport.open()
        self.recorders = {robot.name: MediaRecorder(self._transport, robot.base) for robot in self._robots}
        for recorder in self.recorders.values():
            self._try(recorder, partial(recorder.wait_for_capabilities, _CAPABILITIES_TIMEOUT_S))
            recorder.watch_requests()
        sounds = threading.Thread(target=self._cycle, args=("audio", ALL_SOUND, _AUDIO_TURN_S), daemon=True)
        sounds.start()
        self._cycle("video", ALL_VIDEO, VIDEO_TURN_S)
        sounds.join()
        for recorder in self.recorders.values():
            recorder.close()

    def _cycle(self, medium: Medium, encodings: Sequence[str], seconds: float) -> None:
        while not self._stopping.is_set():
            for encoding in encodings:
                self._ask(medium, encoding)
                if self._wait(_SWITCH_S):
                    return
                self._discard(medium, encoding)
                began = time.monotonic()
                if self._wait(seconds - _SWITCH_S):
                    return
                overloaded = self._overloaded(began, time.monotonic())
                self.results.extend(self._assess(medium, name, encoding).on(overloaded) for name in self.recorders)
            self.rounds += medium == "video"
            if self._once:
                return

    def _ask(self, medium: Medium, encoding: str) -> None:
        for recorder in self.recorders.values():
            recorder.disturbed.discard(medium)
            if medium not in recorder.watched:
                self._try(recorder, partial(recorder.viewer.request, medium, encoding))

    def _try(self, recorder: MediaRecorder, act: partial[None]) -> None:
        try:
            act()
        except PebbleError as error:
            recorder.problem = str(error)

    def _discard(self, medium: Medium, encoding: str) -> None:
        for recorder in self.recorders.values():
            if medium == "video":
                recorder.take_pictures(encoding)
            else:
                recorder.take_sound(encoding)

    def _wait(self, seconds: float) -> bool:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for recorder in self.recorders.values():
                if not recorder.watched:
                    recorder.poll()
            if self._stopping.wait(min(left, _STEP_S)):
                return True
        return False

    def _assess(self, medium: Medium, name: str, encoding: str) -> MediaResult:
        recorder = self.recorders[name]
        capabilities = recorder.viewer.capabilities.get(medium, {})
        if medium in recorder.watched | recorder.disturbed:
            return watched(name, encoding)
        if recorder.problem:
            return MediaResult(name, encoding, "", (recorder.problem,))
        if medium == "video":
            fps = float(capabilities.get("fps") or 0)
            pictures = recorder.take_pictures(encoding)
            if name not in self._counting:
                return assess_rate(name, encoding, [one.captured_s for one in pictures], fps)
            return assess_pictures(name, encoding, pictures, CAMERA_FPS, fps)
        rate = recorder.audio_rate or 16_000
        original = Speech(rate).samples(0, 2 * rate * SPEECH_PERIOD_S)[:, 0].astype(float)
        return assess_sound(name, encoding, recorder.take_sound(encoding), original, rate)
