"""What an operator does to see and hear a robot: reads its capabilities, lifts the flag, asks, and listens."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

from pebble import codec
from pebble.contract import AUDIO_CONTROL, CAPABILITIES, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL, Channel
from pebble.errors import PayloadError, PebbleError
from pebble.payloads import MediaRequest
from pebble.transports import Message, QoS, Transport

log = logging.getLogger(__name__)

Medium = Literal["video", "audio"]
_CONTROLS: dict[Medium, Channel] = {"video": VIDEO_CONTROL, "audio": AUDIO_CONTROL}
_FLAGS: dict[Medium, Channel] = {"video": MQTT_VIDEO, "audio": MQTT_AUDIO}
_REPEAT_S = 2.0  # a request that nothing followed is said again
_JOIN_S = 0.4  # what flows already shows within this time
_KEYFRAME_S = 1.0


class Viewer:
    """One robot's media as they come, over ``transport``, which stays the caller's and must be open.

    ``hear(medium, payload)`` gets each payload, on a thread of the transport. What :meth:`ask` lifted or started is put
    back by :meth:`end`; what others had going before is left to them. A flag that somebody lowers stays down.
    """

    def __init__(self, transport: Transport, base: str, hear: Callable[[Medium, bytes], None]) -> None:
        self.base = base
        self.capabilities: dict[str, Any] = {}
        self._transport, self._hear = transport, hear
        self._known = threading.Event()
        self._flags: dict[str, bool] = {}  # by topic: what is kept there
        self._lifted: set[Medium] = set()
        self._requested: set[Medium] = set()
        self._asked: dict[Medium, str | None] = {}
        self._asked_at: dict[Medium, float] = {}
        self._heard_at: dict[Medium, float] = {}
        self._keyframe_at = float("-inf")
        self._subscriptions = [transport.subscribe(CAPABILITIES.topic(base), self._learn)]

    def wait_known(self, timeout: float) -> None:
        """Wait for the robot to say what it can do; raises PebbleError when it does not."""
        if not self._known.wait(timeout):
            raise PebbleError(f"{self.base} says nothing of what it can do: is the robot up, and is this its broker?")

    def ask(self, medium: Medium, encoding: str | None = None) -> None:
        """Let the medium flow from now on, in ``encoding`` or as configured. Raises PebbleError if there is none."""
        section = self.capabilities.get(medium, {})
        if not (section.get("available") and section.get("controls")):
            raise PebbleError(f"{self.base} offers no {medium}")
        offered = section.get("encodings")
        if encoding is not None and offered is not None and encoding not in offered:
            raise PebbleError(f"{self.base} cannot send {medium} as {encoding}, only as {', '.join(offered)}")
        if medium not in self._asked:
            self._listen(medium)
        self._asked_at[medium] = time.monotonic()  # first: another thread may look after what was asked for
        self._asked[medium] = encoding
        if encoding is None and self._flows(medium):
            return  # somebody watches already: change nothing
        if not self._flags.get(self._topic(medium, "flag_topic", _FLAGS[medium]), False):
            self._lifted.add(medium)
            self._raise_flag(medium, up=True)
        self._request(medium)

    def keep_asking(self) -> None:
        """To be called now and then: says again what was asked for as long as nothing comes."""
        now = time.monotonic()
        for medium in list(self._asked):
            quiet_since = max(self._asked_at[medium], self._heard_at.get(medium, float("-inf")))
            if now - quiet_since > _REPEAT_S:
                self._request(medium)

    def want_keyframe(self, encoding: str | None) -> None:
        """Ask for a full picture in what is sent now, at most once a second."""
        now = time.monotonic()
        if "video" in self._asked and now - self._keyframe_at >= _KEYFRAME_S:
            self._keyframe_at = now
            self._send("video", MediaRequest(enabled=True, encoding=encoding, keyframe=True))

    def end(self) -> None:
        """Withdraw what was asked for, and lower the flags that were down before."""
        for medium in list(self._requested):
            self._send(medium, MediaRequest(enabled=False))
        for medium in list(self._lifted):  # a broker that sends our own words back shortens it meanwhile
            self._raise_flag(medium, up=False)
        for subscription in list(self._subscriptions):
            subscription.close()

    # -- sending

    def _request(self, medium: Medium) -> None:
        self._asked_at[medium] = time.monotonic()
        self._requested.add(medium)
        self._send(medium, MediaRequest(enabled=True, encoding=self._asked[medium]))

    def _flows(self, medium: Medium) -> bool:
        end = time.monotonic() + _JOIN_S
        while medium not in self._heard_at and time.monotonic() < end:
            time.sleep(_JOIN_S / 20)
        return medium in self._heard_at

    def _raise_flag(self, medium: Medium, *, up: bool) -> None:
        topic = self._topic(medium, "flag_topic", _FLAGS[medium])
        self._flags[topic] = up
        self._transport.publish(topic, codec.encode(_FLAGS[medium], up), qos=QoS.DELIVERED, retain=True)

    def _send(self, medium: Medium, request: MediaRequest) -> None:
        topic = self._topic(medium, "command_topic", _CONTROLS[medium])
        self._transport.publish(topic, codec.encode(_CONTROLS[medium], request), qos=QoS.DELIVERED)

    def _topic(self, medium: Medium, key: str, channel: Channel) -> str:
        topic = self.capabilities.get(medium, {}).get(key)
        return topic if isinstance(topic, str) else channel.topic(self.base)

    # -- the transport's threads

    def _learn(self, message: Message) -> None:
        try:
            self.capabilities = codec.decode(CAPABILITIES, message.payload).value
        except PayloadError as error:
            log.warning("capabilities of %s are not understood: %s", self.base, error)
            return
        self._known.set()

    def _listen(self, medium: Medium) -> None:
        flag = self._topic(medium, "flag_topic", _FLAGS[medium])

        def learn_flag(message: Message) -> None:
            try:
                self._flags[flag] = bool(message.payload) and bool(codec.decode(_FLAGS[medium], message.payload))
            except PayloadError:  # nonsense lifts nothing
                self._flags[flag] = False
            if not self._flags[flag]:
                self._lifted.discard(medium)  # somebody else has lowered it: that is theirs to undo

        def take(message: Message) -> None:
            self._heard_at[medium] = time.monotonic()
            self._hear(medium, message.payload)

        self._subscriptions.append(self._transport.subscribe(flag, learn_flag, echo=False, direct=True))
        media = self.capabilities[medium].get("topic")
        if isinstance(media, str):
            self._subscriptions.append(self._transport.subscribe(media, take, qos=QoS.LATEST))
