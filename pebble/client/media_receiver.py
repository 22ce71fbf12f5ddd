"""Receives one robot's pictures and sound, and measures their rate and age."""

import threading
import time

from pebble.client.robot_view import RobotView
from pebble.client.viewer import Medium, Viewer
from pebble.contract import CAPABILITIES
from pebble.errors import PebbleError
from pebble.media.decode import Decoded, VideoDecoder, encoding_of
from pebble.media.rate_meter import RateMeter
from pebble.media.sound import ReceivedSound, SoundDecoder
from pebble.transports import Message, Transport


class MediaReceiver:
    """One robot's pictures and sound. The caller opens and closes ``transport``.

    The transport's threads decode; others may read ``newest``.
    """

    def __init__(self, transport: Transport, base: str) -> None:
        self.robot = RobotView(base)  # by its capabilities
        self.newest: Decoded | None = None
        self.pictures, self.sounds = RateMeter(), RateMeter()
        self.encoding: dict[Medium, str] = {}  # of the last payload
        self._video, self._audio = VideoDecoder(), SoundDecoder()
        self.viewer = Viewer(transport, base, self._on_payload)
        self._is_known = threading.Event()
        self._capabilities = transport.subscribe(CAPABILITIES.topic(base), self._on_capabilities)

    def wait_for_capabilities(self, timeout: float) -> None:
        """Wait for the robot's capabilities; raises PebbleError on timeout."""
        if not self._is_known.wait(timeout):
            raise PebbleError(f"{self.robot.base} publishes no capabilities: is the robot up, and is this its broker?")

    def request(self, encoding: str | None, *, sound: bool) -> None:
        """Request pictures, and sound if the robot has it. Raises PebbleError if it has no pictures."""
        self.viewer.request("video", encoding)
        if sound and self.viewer.capabilities.get("audio", {}).get("available"):
            self.viewer.request("audio")

    def poll(self) -> None:
        """Call this a few times a second: repeats unanswered requests, and requests a key frame if one is missing."""
        self.viewer.repeat_requests()
        if self._video.wants_keyframe:
            self.viewer.request_keyframe(self.encoding.get("video"))

    def summary(self, medium: Medium, now: float) -> str:
        """A line for display: ``h264 10/s 212 kbit/s, 45 ms``; empty while nothing arrives."""
        meter = self.pictures if medium == "video" else self.sounds
        rate, age_s = meter.rate(now), meter.age_s(now)
        if not rate or medium not in self.encoding:
            return ""
        age = "" if age_s is None else f", {1000 * age_s:.0f} ms"
        return f"{self.encoding[medium]} {rate:.0f}/s {meter.bitrate(now) / 1000:.0f} kbit/s{age}"

    def close(self) -> None:
        self._capabilities.close()
        self.viewer.close()

    def on_picture(self, picture: Decoded) -> None:
        """Override to get every picture, not only the newest; runs on a thread of the transport."""

    def on_sound(self, received: ReceivedSound) -> None:
        """Override to get every packet of sound; runs on a thread of the transport."""

    # -- the transport's threads

    def _on_capabilities(self, message: Message) -> None:
        self.robot.receive(CAPABILITIES, message, 0.0, 0.0)
        self.viewer.capabilities = self.robot.capabilities
        if self.robot.estop.has_capabilities:
            self._is_known.set()

    def _on_payload(self, medium: Medium, payload: bytes) -> None:
        if medium == "video":
            self._on_video(payload)
        else:
            self._on_audio(payload)

    def _on_video(self, payload: bytes) -> None:
        picture = self._video.feed(payload)
        age_s = None if picture is None or picture.captured_ms is None else time.time() - picture.captured_ms / 1000
        self.pictures.add(time.monotonic(), len(payload), age_s)
        encoding = encoding_of(payload) if picture is None else picture.encoding
        if encoding is not None:
            self.encoding["video"] = encoding
        if picture is not None:
            self.newest = picture
            self.on_picture(picture)

    def _on_audio(self, payload: bytes) -> None:
        received = self._audio.feed(payload)
        if received is None:
            return
        self.sounds.add(time.monotonic(), len(payload), time.time() - received.captured_ms / 1000)
        self.encoding["audio"] = received.encoding
        self.on_sound(received)
