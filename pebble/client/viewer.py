"""Requests one robot's pictures and sound as an operator does: sets flags, sends requests."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, Literal

from pebble.client.robot_topics import topic_of
from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL, Channel, codec
from pebble.contract.payloads import MediaRequest
from pebble.errors import PayloadError, PebbleError
from pebble.transports import Message, QoS, Subscription, Transport

Medium = Literal["video", "audio"]
_CONTROLS: dict[Medium, Channel] = {"video": VIDEO_CONTROL, "audio": AUDIO_CONTROL}
_FLAGS: dict[Medium, Channel] = {"video": MQTT_VIDEO, "audio": MQTT_AUDIO}
_REPEAT_S = 2.0  # without a payload before a request is repeated
_FLAG_S = 0.2  # a retained flag arrives within this time of subscribing
_JOIN_S = 0.4  # a stream that is already running delivers a payload within this time
_KEYFRAME_S = 1.0
_SENT = 20


class Viewer:
    """One robot's media payloads. The caller opens ``transport`` before and closes it afterwards.

    ``on_payload(medium, payload)`` runs on a thread of the transport. :meth:`close` withdraws the requests made by
    :meth:`request` and lowers the flags it raised; what was running before stays. A flag that another operator lowers
    stays lowered.
    """

    def __init__(
        self,
        transport: Transport,
        base: str,
        on_payload: Callable[[Medium, bytes], None],
        capabilities: dict[str, Any] | None = None,
    ) -> None:
        """``capabilities``: the robot's, as far as they are known."""
        self.base = base
        self.capabilities = capabilities or {}
        self.sent: deque[bytes] = deque(maxlen=_SENT)  # own requests: what else arrives on their topic is from others
        self._transport, self._on_payload = transport, on_payload
        self._flags: dict[str, bool] = {}  # by topic: the retained value
        self._raised: set[Medium] = set()
        self._requested: set[Medium] = set()
        self._subscribed_at: dict[Medium, float] = {}
        self._encodings: dict[Medium, str | None] = {}  # of each requested medium; None: as configured
        self._requested_at: dict[Medium, float] = {}
        self._received_at: dict[Medium, float] = {}
        self._keyframe_at = float("-inf")
        self._subscriptions: list[Subscription] = []

    def request(self, medium: Medium, encoding: str | None = None) -> None:
        """Start ``medium`` in ``encoding``, or as configured. Raises PebbleError if the robot does not offer it."""
        section = self.capabilities.get(medium, {})
        if not (section.get("available") and section.get("controls")):
            raise PebbleError(f"{self.base} offers no {medium}")
        offered = section.get("encodings")
        if encoding is not None and offered is not None and encoding not in offered:
            raise PebbleError(f"{self.base} cannot send {medium} as {encoding}, only as {', '.join(offered)}")
        if medium not in self._encodings:
            self._subscribe(medium)
            self._subscribed_at[medium] = time.monotonic()
        self._requested_at[medium] = time.monotonic()  # before _encodings, whose keys another thread iterates over
        self._encodings[medium] = encoding
        if encoding is None and self._is_running(medium):
            return  # another operator has requested it: change nothing
        if not self._is_raised(medium):
            self._raised.add(medium)
            self._set_flag(medium, up=True)
        self._send_request(medium)

    def repeat_requests(self) -> None:
        """Call this now and then: sends each request again while no payload arrives."""
        now = time.monotonic()
        for medium in list(self._encodings):
            quiet_since = max(self._requested_at[medium], self._received_at.get(medium, float("-inf")))
            if now - quiet_since > _REPEAT_S:
                self._send_request(medium)

    def request_keyframe(self, encoding: str | None) -> None:
        """Request a full picture in the present encoding, at most once a second."""
        now = time.monotonic()
        if "video" in self._encodings and now - self._keyframe_at >= _KEYFRAME_S:
            self._keyframe_at = now
            self._send("video", MediaRequest(enabled=True, encoding=encoding, keyframe=True))

    def hand_over(self, medium: Medium) -> None:
        """Leave a medium to another operator who has requested it, too: :meth:`close` does not withdraw it."""
        self._requested.discard(medium)
        self._raised.discard(medium)

    def close(self) -> None:
        """Withdraw the requests, and lower the flags that were down before."""
        for medium in list(self._requested):
            self._send(medium, MediaRequest(enabled=False))
        for medium in list(self._raised):  # a copy: a broker that sends our publishes back removes entries meanwhile
            self._set_flag(medium, up=False)
        for subscription in list(self._subscriptions):
            subscription.close()

    # -- sending

    def _send_request(self, medium: Medium) -> None:
        self._requested_at[medium] = time.monotonic()
        self._requested.add(medium)
        self._send(medium, MediaRequest(enabled=True, encoding=self._encodings[medium]))

    def _is_running(self, medium: Medium) -> bool:
        end = time.monotonic() + _JOIN_S
        while medium not in self._received_at and time.monotonic() < end:
            time.sleep(_JOIN_S / 20)
        return medium in self._received_at

    def _is_raised(self, medium: Medium) -> bool:
        flag, end = self.topic(_FLAGS[medium]), self._subscribed_at[medium] + _FLAG_S
        while flag not in self._flags and time.monotonic() < end:
            time.sleep(_FLAG_S / 20)
        return self._flags.get(flag, False)

    def _set_flag(self, medium: Medium, *, up: bool) -> None:
        topic = self.topic(_FLAGS[medium])
        self._flags[topic] = up
        self._transport.publish(
            topic, codec.encode(_FLAGS[medium], up), qos=QoS.DELIVERED, retain=True, shared=True, urgent=True
        )

    def _send(self, medium: Medium, request: MediaRequest) -> None:
        topic = self.topic(_CONTROLS[medium])
        payload = codec.encode(_CONTROLS[medium], request)
        self.sent.append(payload)
        self._transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)

    def topic(self, channel: Channel) -> str:
        """Return the topic that capabilities name for ``channel``, else the channel's own."""
        return topic_of(self.base, self.capabilities, channel)

    # -- the transport's threads

    def _subscribe(self, medium: Medium) -> None:
        flag = self.topic(_FLAGS[medium])

        def on_flag(message: Message) -> None:
            try:
                self._flags[flag] = bool(message.payload) and bool(codec.decode(_FLAGS[medium], message.payload))
            except PayloadError:  # a malformed flag counts as lowered
                self._flags[flag] = False
            if not self._flags[flag]:
                self._raised.discard(medium)  # another operator has lowered it, so raising it again is theirs, too

        self._subscriptions.append(self._transport.subscribe(flag, on_flag, echo=False, direct=True))
        media = self.capabilities[medium].get("topic")
        if isinstance(media, str):

            def on_media(message: Message) -> None:
                self._received_at[medium] = time.monotonic()
                self._on_payload(medium, message.payload)

            self._subscriptions.append(self._transport.subscribe(media, on_media, qos=QoS.LATEST))
