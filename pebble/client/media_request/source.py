"""Requests one medium of one robot, its pictures or its sound, and withdraws the request afterwards."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from pebble.client.broker import Broker
from pebble.client.robot_topics import FLAGS, names
from pebble.client.viewer import Medium, Viewer
from pebble.contract import AUDIO, AUDIO_CONTROL, CAMERA, VIDEO_CONTROL, Channel
from pebble.errors import PebbleError

log = logging.getLogger(__name__)

_MAX_PENDING, _MAX_PENDING_BYTES = 2000, 16 << 20  # received, and not yet taken by the event loop
#: The channels whose topics capabilities may name, by its key in the medium's section.
_NAMED: Final[dict[Medium, dict[str, Channel]]] = {
    "video": {"topic": CAMERA, "command_topic": VIDEO_CONTROL, "flag_topic": FLAGS["video"]},
    "audio": {"topic": AUDIO, "command_topic": AUDIO_CONTROL, "flag_topic": FLAGS["audio"]},
}


class _Words(NamedTuple):
    """How people are told of a medium."""

    lacking: str
    fixed: str
    name: str


_WORDS: Final[dict[Medium, _Words]] = {
    "video": _Words("it has no camera", "its camera cannot be switched on from here", "pictures"),
    "audio": _Words("it has no sound", "its sound cannot be switched on from here", "sound"),
}


def offered(capabilities: dict[str, Any], medium: Medium) -> tuple[str, ...]:
    """The encodings that may be requested; empty for robots that do not list any, whose requests name none."""
    section = capabilities.get(medium)
    listed = section.get("encodings") if isinstance(section, dict) else None
    return tuple(name for name in listed if isinstance(name, str)) if isinstance(listed, list) else ()


def refusal(ref: str, capabilities: dict[str, Any], medium: Medium) -> str:
    """Why this robot's pictures, or its sound, are not requested; empty if they may be.

    Capabilities come from the network: one that names topics of another component, or channel, is not believed at all.
    """
    if not capabilities:
        return "it has published no capabilities yet"
    section, words = capabilities.get(medium), _WORDS[medium]
    if not isinstance(section, dict) or section.get("available") is not True:
        return words.lacking
    if section.get("controls") is not True:
        return words.fixed
    for key, channel in _NAMED[medium].items():
        if section.get(key) is not None and not names(ref, section[key], channel):
            return f"its capabilities name a topic for {words.name} that is not its own ({key})"
    return ""


class MediaSource:
    """One robot's payloads, on the event loop. One task calls its coroutines."""

    def __init__(self, broker: Broker, ref: str, medium: Medium, receive: Callable[[bytes], None]) -> None:
        self.ref, self.medium = ref, medium
        self.encoding: str | None = None  # as requested
        self.requested_at = float("-inf")
        self._broker, self._receive = broker, receive
        self._viewer: Viewer | None = None
        self._topics: list[object] = []  # that the capabilities listed at the request
        self._pending = self._pending_bytes = 0
        self._lock = threading.Lock()  # guards the last two

    @property
    def started(self) -> bool:
        return self._viewer is not None

    async def follow(self, capabilities: dict[str, Any], encoding: str | None) -> None:
        """Request it as these capabilities, which :func:`refusal` allows, offer it; call it again and again.

        Raises PebbleError.
        """
        topics = [capabilities[self.medium].get(key) for key in _NAMED[self.medium]]
        if self._viewer is None or topics != self._topics:
            await self.withdraw()
            self._viewer = Viewer(self._broker.transport, self.ref, self._on_payload, capabilities)
            self._topics = topics
            await self._request(encoding)
            return
        self._viewer.capabilities = capabilities
        if encoding != self.encoding:
            await self._request(encoding)
        else:
            await asyncio.to_thread(self._viewer.repeat_requests)

    async def request_keyframe(self, encoding: str) -> None:
        """Request a key frame in the present encoding; the viewer lets one pass each second."""
        if self._viewer is not None:
            known = encoding if encoding in offered(self._viewer.capabilities, self.medium) else None
            await asyncio.to_thread(self._viewer.request_keyframe, known)

    async def withdraw(self) -> None:
        """End the request."""
        viewer, self._viewer = self._viewer, None
        self.encoding, self.requested_at = None, float("-inf")
        if viewer is not None:
            await asyncio.to_thread(self._close, viewer)

    async def _request(self, encoding: str | None) -> None:
        if self._viewer is None:
            return
        self.encoding, self.requested_at = encoding, time.monotonic()
        try:
            await asyncio.to_thread(self._viewer.request, self.medium, encoding)
        except PebbleError:
            await self.withdraw()
            raise

    def _close(self, viewer: Viewer) -> None:
        try:
            viewer.close()
        except PebbleError as error:
            log.warning("the %s of %s: %s", _WORDS[self.medium].name, self.ref, error)

    # -- a thread of the transport

    def _on_payload(self, _medium: Medium, payload: bytes) -> None:
        size = len(payload)
        with self._lock:
            if self._pending >= _MAX_PENDING or self._pending_bytes + size > _MAX_PENDING_BYTES:
                return  # the event loop is far behind; what is missing is noticed by the numbers
            self._pending += 1
            self._pending_bytes += size
        try:
            self._broker.loop.call_soon_threadsafe(self._take, payload)
        except RuntimeError:  # the loop has ended
            return

    def _take(self, payload: bytes) -> None:
        with self._lock:
            self._pending -= 1
            self._pending_bytes -= len(payload)
        if self._viewer is not None:
            self._receive(payload)
