"""Somebody who watches and listens to one robot: decodes what comes, and keeps the newest and the figures."""

from __future__ import annotations

import time
from collections import deque

from pebble.media.decode import Decoded, VideoDecoder, encoding_of
from pebble.media.figures import Figures
from pebble.media.sound import Heard, SoundDecoder
from pebble.media.viewer import Medium, Viewer
from pebble.transports import Transport

_SOUNDS = 500  # decoded packets that wait to be taken: ten seconds of the usual ones


class Audience:
    """One robot's pictures and sound, over ``transport``, which stays the caller's.

    The transport's threads decode; ``newest`` and :meth:`take_sounds` may be read by any one thread.
    """

    def __init__(self, transport: Transport, base: str) -> None:
        self.name = base.rpartition("/")[2]
        self.newest: Decoded | None = None
        self.pictures, self.sounds = Figures(), Figures()
        self.encoding: dict[Medium, str] = {}  # of what came last
        self._video, self._audio = VideoDecoder(), SoundDecoder()
        self._heard: deque[Heard] = deque(maxlen=_SOUNDS)
        self.viewer = Viewer(transport, base, self._hear)

    def wait_known(self, timeout: float) -> None:
        """Wait for the robot's capabilities; raises PebbleError when they do not come."""
        self.viewer.wait_known(timeout)

    def begin(self, encoding: str | None, *, sound: bool) -> None:
        """Ask for pictures, and for sound where the robot has it. Raises PebbleError if it has no pictures."""
        self.viewer.ask("video", encoding)
        if sound and self.viewer.capabilities.get("audio", {}).get("available"):
            self.viewer.ask("audio")

    def keep_going(self) -> None:
        """To be called a few times a second: asks for what is missing."""
        self.viewer.keep_asking()
        if self._video.wants_keyframe:
            self.viewer.want_keyframe(self.encoding.get("video"))

    def take_sounds(self) -> list[Heard]:
        """What was heard since the last time, in the order it came."""
        taken = []
        while self._heard:
            taken.append(self._heard.popleft())
        return taken

    def summary(self, medium: Medium, now: float) -> str:
        """For people: ``h264 10/s 212 kbit/s, 45 ms``; empty while nothing comes."""
        figures = self.pictures if medium == "video" else self.sounds
        rate, age_s = figures.rate(now), figures.age_s(now)
        if not rate or medium not in self.encoding:
            return ""
        age = "" if age_s is None else f", {1000 * age_s:.0f} ms"
        return f"{self.encoding[medium]} {rate:.0f}/s {figures.bitrate(now) / 1000:.0f} kbit/s{age}"

    def end(self) -> None:
        self.viewer.end()

    # -- the transport's threads, one per medium

    def _hear(self, medium: Medium, payload: bytes) -> None:
        if medium == "video":
            self._see(payload)
        else:
            self._listen(payload)

    def _see(self, payload: bytes) -> None:
        seen = self._video.feed(payload)
        age_s = None if seen is None or seen.captured_ms is None else time.time() - seen.captured_ms / 1000
        self.pictures.add(time.monotonic(), len(payload), age_s)
        encoding = encoding_of(payload) if seen is None else seen.encoding
        if encoding is not None:
            self.encoding["video"] = encoding
        if seen is not None:
            self.newest = seen
            self.on_picture(seen)

    def _listen(self, payload: bytes) -> None:
        heard = self._audio.feed(payload)
        if heard is None:
            return
        self.sounds.add(time.monotonic(), len(payload), time.time() - heard.captured_ms / 1000)
        self.encoding["audio"] = heard.encoding
        self._heard.append(heard)
        self.on_sound(heard)

    def on_picture(self, seen: Decoded) -> None:
        """For those who want every picture, not only the newest; on a thread of the transport."""

    def on_sound(self, heard: Heard) -> None:
        """The same for sound."""
