"""The source of a recorder's messages: a broker, or a robot's local transport."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Final

from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.topics import matches

#: Topics of a replay: recorded only where a filter names them.
REPLAYED: Final = "replay/"
#: How long a connection for retained messages waits for the next one before it ends.
_QUIET_S: Final = 1.0
_LONGEST_S: Final = 60.0
#: The reason of a broker that knows only MQTT 3.1.1, which does not show how a live message was published.
_OLD_BROKER: Final = "unsupported protocol version"
_LOSSES: Final = ("too_long", "malformed")  # messages that a transport has dropped


class Source:
    """A connection whose messages are recorded, and whose changes are recorded as events.

    MQTT 5's retain-as-published shows which live messages were published to be retained, but they look like the old
    ones that the broker has retained. Besides, brokers send only some 1,000 retained messages with QoS 1. So each
    connection to a broker has a second one, which fetches the retained messages with QoS 0 and ends.
    """

    def __init__(self, recorder: Recorder, kind: str, settings: Any, filters: Iterable[str], name: str = "") -> None:
        self._recorder, self._kind, self._name = recorder, kind, name
        self._filters = list(dict.fromkeys(filters))
        #: The topics of a replay, which repeat what was recorded; not ignored if a filter names them.
        self._ignored = () if any(filter_.startswith(REPLAYED) for filter_ in self._filters) else (REPLAYED,)
        self._settings = settings
        self._is_modern = True  # the broker knows MQTT 5, as far as we know
        self._lost_at = 0  # nanoseconds since 1970; 0: connected, or never was
        self._losses: dict[str, int] = {}  # messages that the transport dropped, by reason, as noted last
        self._fetching: _RetainedFetch | None = None
        self._wants_fetch = self._was_connected = False  # retained messages are to be fetched; it was connected once
        self._transport = self._make()

    @property
    def connected(self) -> bool:
        return self._transport.state is State.CONNECTED

    @property
    def problem(self) -> str:
        return self._transport.problem

    def start(self, timeout: float = 3.0) -> None:
        """Connect, and keep trying. Raises TransportError for settings that can never work."""
        self._open(timeout)
        self.check()

    def check(self) -> None:
        """Record how much the transport dropped; begin and end fetching retained messages. Called once a second."""
        counted = self._transport.counters.snapshot()
        for name in _LOSSES:
            new = counted.get(name, 0) - self._losses.get(name, 0)
            if new > 0:
                self._losses[name] = counted[name]
                self._recorder.note("dropped", messages=new, why=name, **self._about)
        if self._kind == "mqtt" and self._is_modern and _OLD_BROKER in self.problem:
            self._transport.close()
            self._is_modern = False
            self._transport = self._make()
            self._losses.clear()  # the new one counts from zero
            self._open(0.0)
        fetching = self._fetching
        if fetching is not None and (fetching.is_done or self._wants_fetch):
            fetching.close()
            self._fetching = None
            if fetching.failed:
                self._recorder.note("dropped", why="the retained messages cannot be fetched", **self._about)
        if self._wants_fetch:
            self._wants_fetch = False
            self._fetching = _RetainedFetch(self._settings, self._filters, self._record_retained)

    def close(self) -> None:
        self._transport.close()
        if self._fetching is not None:
            self._fetching.close()

    def _open(self, timeout: float) -> None:
        self._transport.on_state(self._watch)
        self._transport.open(timeout)
        for filter_, receive in _once(self._filters, self._receive):
            self._transport.subscribe(filter_, receive, qos=QoS.DELIVERED, echo=False, direct=True)

    @property
    def _about(self) -> dict[str, str]:
        return {"source": self._name} if self._name else {}

    def _make(self) -> Transport:
        if self._kind == "mqtt":
            modern = self._is_modern
            protocol = "5" if modern else "3.1.1"
            settings = replace(self._settings, protocol=protocol, as_published=modern, sends_retained=not modern)
            return create("mqtt", "pebble-recorder", settings)
        return create(self._kind, "pebble-recorder", self._settings)

    # -- the transport's threads

    def _watch(self, state: State) -> None:
        """Record that the connection was made or lost; a new one brings all retained messages again."""
        now_ns = self._recorder.clock.now()
        if state is State.CONNECTED:
            if self._lost_at:
                self._recorder.note_gap(self._lost_at, "no connection", **self._about)
            self._lost_at = 0
            self._recorder.note("connected", **self._about)
            self._wants_fetch = self._kind == "mqtt"
            self._recorder.forget_retained(self._name)
            self._was_connected = True
        elif state is State.CONNECTING and self._was_connected and not self._lost_at:
            self._lost_at = now_ns
            self._recorder.note("lost", why=self.problem, **self._about)

    def _receive(self, message: Message) -> None:
        """Record a message; an old one only where no second connection fetches those."""
        if message.topic.startswith(self._ignored):
            return
        # The retain flag marks an old value. Not so with as_published, but then the broker sends no old ones (_make).
        is_live = self._transport.as_published or not message.retain
        if is_live:
            self._recorder.receive(
                message.topic, message.payload, int(message.qos), message.retain_requested, source=self._name
            )
        elif self._kind != "mqtt":  # see _RetainedFetch
            self._record_retained(message)

    def _record_retained(self, message: Message) -> None:
        if message.topic.startswith(self._ignored):
            return
        self._recorder.receive(message.topic, message.payload, None, True, retained=True, source=self._name)


class _RetainedFetch:
    """A connection that fetches the retained messages of a broker."""

    def __init__(self, settings: MqttSettings, filters: list[str], record: Callable[[Message], None]) -> None:
        self._record = record
        self._quiet_since = float("inf")  # not connected yet
        self._ends_at = time.monotonic() + _LONGEST_S
        id_ = settings.client_id and f"{settings.client_id}-retained"  # else None, as in ``settings``
        # Without retain-as-published only old messages have the retain flag. For QoS 0 see :class:`Source`.
        plain = replace(settings, as_published=False, sends_retained=True, max_qos=0, client_id=id_)
        self._transport = create("mqtt", "pebble-recorder-retained", plain)
        self._transport.on_state(self._watch)
        self._transport.open(0.0)
        for filter_, receive in _once(filters, self._receive):  # each message counts once
            self._transport.subscribe(filter_, receive, direct=True)

    @property
    def is_done(self) -> bool:
        now = time.monotonic()
        return now - self._quiet_since > _QUIET_S or now > self._ends_at

    @property
    def failed(self) -> bool:
        """True if time is up too early: there is no connection yet, or retained messages still arrive."""
        now = time.monotonic()
        return now > self._ends_at and now - self._quiet_since <= _QUIET_S

    def close(self) -> None:
        self._transport.close()

    def _watch(self, state: State) -> None:
        if state is State.CONNECTED:
            self._quiet_since = time.monotonic()

    def _receive(self, message: Message) -> None:
        if message.retain:
            self._quiet_since = time.monotonic()
            self._record(message)


def _once(filters: list[str], receive: Callable[[Message], None]) -> Iterator[tuple[str, Callable[[Message], None]]]:
    """Yield each filter with its handler. A message that matches several filters is received once."""
    for number, filter_ in enumerate(filters):
        yield filter_, partial(_receive_unless, filters[:number], receive) if number else receive


def _receive_unless(earlier: list[str], receive: Callable[[Message], None], message: Message) -> None:
    if not any(matches(filter_, message.topic) for filter_ in earlier):
        receive(message)
