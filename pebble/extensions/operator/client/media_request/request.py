"""A request for a robot's pictures or sound: the messages that begin it, keep it, and end it. Pure."""

from collections import deque
from contextlib import suppress
from typing import Any, Final

from pebble.contract import codec
from pebble.contract.payloads import MediaRequest
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.operator.client.media_request.offer import CHANNELS, Medium, offered
from pebble.extensions.operator.client.robot_topics import topic_of
from pebble.transports import Message, QoS, Transport

_REPEAT_S: Final = 2.0  # without a payload before a request is repeated
_FLAG_S: Final = 0.2  # a retained flag arrives within this time of subscribing
_JOIN_S: Final = 0.4  # a stream that is already running delivers a payload within this time,
_SLOW_S: Final[dict[Medium, float]] = {"video": 1.2, "audio": _JOIN_S}  # also one of a picture a second
_KEYFRAME_S: Final = 1.0
_SENT: Final = 20


class ViewerRequest:
    """A request for one medium of one robot. Times are seconds of a monotonic clock.

    Subscribe to ``flag_topic`` and ``media_topic``, pass what arrives to :meth:`receive`, and publish the other
    methods' messages by :func:`send`. A medium that was running before stays, and a flag that another operator lowers
    stays lowered. A medium is running if a payload of it has arrived.

    With ``shares``, subscribe to ``control_topic`` as well: a stream that others use keeps its encoding, and is left
    to them at the end.
    """

    def __init__(self, base: str, medium: Medium, capabilities: dict[str, Any], *, shares: bool = False) -> None:
        self._shares = shares  # the medium with other clients, whose encoding stays
        self.sent: deque[bytes] = deque(maxlen=_SENT)  # this client's requests, which come back on their topic
        self._others: MediaRequest | None = None  # what other clients request; None: nothing, as far as is known
        self.settled = False  # the first request was sent, or need not be sent. Until then call :meth:`tick` often
        topics = (topic_of(base, capabilities, channel) for channel in CHANNELS[medium])
        self.media_topic, self.control_topic, self.flag_topic = topics
        self.section: dict[str, Any] = capabilities.get(medium) or {}  # of the newest capabilities
        self._base, self._medium = base, medium
        _, self._control, self._flag = CHANNELS[medium]
        self._encoding: str | None = None  # as wanted here; None: as configured
        self._is_up: bool | None = None  # the flag that allows the medium; None: not known
        self._raised = False  # this client has raised the flag, so it lowers it at the end
        self._requested = False  # this client has sent a request, so it withdraws it at the end
        self._began_at = self._sent_at = self._received_at = self._keyframe_at = float("-inf")

    def check(self, encoding: str | None) -> None:
        """Raise PebbleError unless the robot offers the medium, and in ``encoding`` if that is not None."""
        if not (self.section.get("available") and self.section.get("controls")):
            raise PebbleError(f"{self._base} offers no {self._medium}")
        listed = self._encodings()
        if encoding is not None and listed and encoding not in listed:
            raise PebbleError(f"{self._base} cannot send {self._medium} as {encoding}, only as {', '.join(listed)}")

    def want(self, encoding: str | None, now: float) -> None:
        """Request the medium in ``encoding``, or as configured, with the next ticks. Raises PebbleError.

        Call it once the topics are subscribed to: :meth:`tick` waits a little first, as the medium may be running.
        """
        self.check(encoding)
        self._encoding, self._began_at, self.settled = encoding, now, False

    def receive(self, message: Message, now: float) -> bool:
        """Handle a message of its topics; return True if it is a payload of the medium."""
        if message.topic == self.control_topic:
            self._receive_request(message)
            return False
        if message.topic != self.flag_topic:
            self._received_at = now
            return True
        try:
            self._is_up = bool(message.payload) and bool(codec.decode(self._flag, message.payload))
        except PayloadError:  # a malformed flag counts as lowered
            self._is_up = False
        if not self._is_up:  # another client has lowered it, which ends all requests
            self._raised, self._others = False, None
        return False

    def _receive_request(self, message: Message) -> None:
        """Note another client's request, unless it is only for a key frame.

        Recognise this client's own, which come back.
        """
        if message.payload in self.sent:
            self.sent.remove(message.payload)
        elif not message.retain:  # a retained command is stale
            with suppress(PayloadError):
                request = codec.decode(self._control, message.payload)
                if not request.keyframe:
                    self._others = request if request.enabled else None

    def tick(self, now: float) -> list[Message]:
        """Return the messages to send now.

        First wait a moment (:meth:`_waits_s`) for a sign that the medium runs already. If it does, send nothing, unless
        another encoding is wanted here and no other client uses the medium. Otherwise raise the flag if it is down,
        and send the request. After either, repeat the request whenever no payload has come for a while.
        """
        if self.settled:
            is_quiet = now - max(self._sent_at, self._received_at) > _REPEAT_S
            return [self._ask(now)] if is_quiet else []
        has_received = self._received_at > float("-inf")  # so the medium is running
        if has_received and self._shares and not self._requested and self._others is None:
            self._others = MediaRequest(enabled=True)  # others have requested it before this client listened
        if self._others is not None or (has_received and self._encoding is None):
            self.settled, self._sent_at = True, now  # it runs already: change nothing
            return []
        if now < self._began_at + self._waits_s():
            return []
        self.settled, messages = True, [self._ask(now)]
        if not self._is_up:
            self._is_up = self._raised = True
            messages.insert(0, self._flag_message(up=True))
        return messages

    def _waits_s(self) -> float:
        """Return how long to wait, before the request, for a payload or the flag."""
        if self._encoding is None:  # a running medium is taken as it is
            return _JOIN_S
        if self._is_up is None:  # :meth:`tick` must know whether to raise the flag
            return _FLAG_S
        may_be_of_others = self._shares and self._is_up and not self._requested  # if so, a payload comes soon
        return _SLOW_S[self._medium] if may_be_of_others else 0.0

    def keyframe(self, encoding: str | None, now: float) -> list[Message]:
        """Request a key frame in the encoding that arrives, at most once a second."""
        if now - self._keyframe_at < _KEYFRAME_S:
            return []
        self._keyframe_at = now
        listed = encoding if encoding in self._encodings() else None
        return [self._message(MediaRequest(enabled=True, encoding=listed, keyframe=True))]

    def end(self) -> list[Message]:
        """Withdraw the request, and lower the flag if this client has raised it, unless others use the medium."""
        messages: list[Message] = []
        if self._requested and self._others is None:
            messages.append(self._message(MediaRequest(enabled=False)))
        if self._raised and self._others is None:
            messages.append(self._flag_message(up=False))
        self._requested = self._raised = False
        return messages

    def _encodings(self) -> tuple[str, ...]:
        return offered({self._medium: self.section}, self._medium)

    def _ask(self, now: float) -> Message:
        """Return the request. It keeps the encoding of others that had requested the medium: they may come back."""
        if self._others is not None:
            self._encoding, self._others = self._others.encoding, None
        self._sent_at, self._requested = now, True
        return self._message(MediaRequest(enabled=True, encoding=self._encoding))

    def _message(self, request: MediaRequest) -> Message:
        payload = codec.encode(self._control, request)
        self.sent.append(payload)
        return Message(self.control_topic, payload, QoS.DELIVERED)

    def _flag_message(self, *, up: bool) -> Message:
        return Message(self.flag_topic, codec.encode(self._flag, up), QoS.DELIVERED, retain=True)


def send(transport: Transport, messages: list[Message]) -> None:
    """Publish the messages of a request. Raises TransportError."""
    for message in messages:
        transport.publish(
            message.topic, message.payload, qos=message.qos, retain=message.retain, shared=message.retain, urgent=True
        )
