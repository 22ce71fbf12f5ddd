"""An observer of a robot: all messages that it publishes, and commands to it, as one client sees them."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.names import with_name
from pebble.errors import PayloadError
from pebble.extensions.operator.client.connection import Target, connected, put_account_into_topics, wait_for
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.client.robot_topics import section_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS, Transport

ANSWER_S = 1.0  # within which a robot answers
_MOST = 50_000  # messages that are kept; a robot at rest sends some ten a second
_RETAINED_S = 1.0  # some brokers send what is retained a moment after the subscription


@dataclass(frozen=True, slots=True)
class Record:
    """A received message: its time of arrival (monotonic), and its value or, in ``wrong``, why it has none."""

    at: float
    metric: str  # below the base: ``outgoing/online``
    payload: bytes
    retain: bool
    channel: c.Channel | None
    value: Any = None
    wrong: str = ""


class Observer:
    """The messages of one robot on one connection. They are read in :meth:`wait`."""

    def __init__(self, target: Target, transport: Transport, names: Names, filters: Iterable[str] = ()) -> None:
        """Subscribe to all that the robot publishes, or to ``filters`` instead."""
        self.base, self.target, self.transport, self.account = names.base, target, transport, names.account
        self._names, self.view = names, RobotView(self.base)
        self.records: deque[Record] = deque(maxlen=_MOST)
        self.listeners: list[Callable[[Message, float], None]] = []  # get each message, and when it arrived (monotonic)
        #: Returns each change of the wheels' speeds as seen from outside: when (monotonic), and left and right.
        self.eyes: Callable[[], list[tuple[float, list[float]]]] = list  # nothing is seen from outside
        self._of: defaultdict[c.Channel | None, deque[Record]] = defaultdict(lambda: deque(maxlen=_MOST))  # by channel
        self._slowest_s = ANSWER_S / 4  # of its answers so far, at least this; :attr:`patience_s` follows from it
        self._arrived: deque[tuple[Message, float, float]] = deque(maxlen=_MOST)  # with the times, monotonic and epoch
        # If the robot checks names, its commands have this client's account in their topics.
        put_account_into_topics(transport, names, lambda base: base == self.base and self.view.named)
        for filter_ in filters or (f"{self.base}/{c.OUTGOING}/#",):
            transport.subscribe(filter_, self._take, qos=QoS.DELIVERED, direct=True)  # no thread: it only stores

    def _take(self, message: Message) -> None:
        self._arrived.append((message, time.monotonic(), time.time()))

    # -- what arrives

    def read(self) -> None:
        """Handle the messages that have arrived."""
        while self._arrived:
            message, at, wall = self._arrived.popleft()
            record = self.record_of(message, at)
            self.records.append(record)
            self._of[record.channel].append(record)
            self.view.receive(record.channel, message, at, wall)
            for listener in self.listeners:
                listener(message, at)

    def record_of(self, message: Message, at: float) -> Record:
        """Return a message with its channel and its decoded value."""
        channel = self._names.channel(message.topic)
        value, wrong = None, ""
        try:
            if channel is not None and message.payload:
                value = codec.decode(channel, message.payload)
        except PayloadError as error:
            wrong = str(error)
        metric = message.topic.removeprefix(f"{self.base}/")
        return Record(at, metric, message.payload, message.retain, channel, value, wrong)

    def of(self, channel: c.Channel, since: float = 0.0, *, retained: bool = False) -> list[Record]:
        """Return the robot's live messages of a channel, or with ``retained`` all of them."""
        return [
            record
            for record in self._of[channel]
            if record.at >= since and record.payload and (retained or not record.retain)
        ]

    # -- time

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Read messages until ``condition`` holds; return False if it does not within ``seconds``."""
        return wait_for(condition, seconds, self.read)

    def look(self, seconds: float) -> float:
        """Read messages for ``seconds``; return the time when that began."""
        began = time.monotonic()
        self.wait(lambda: False, seconds)
        return began

    def answers(self, condition: Callable[[], object], seconds: float = ANSWER_S) -> bool:
        """True if ``condition`` becomes true within the time that a robot has for an answer."""
        began = time.monotonic()
        is_met = self.wait(condition, seconds)
        if is_met:
            self._slowest_s = max(self._slowest_s, time.monotonic() - began)
        return is_met

    @property
    def patience_s(self) -> float:
        """Return how long to wait before concluding that something does not happen (seconds)."""
        return 2 * self._slowest_s

    def happens(self, condition: Callable[[], object]) -> bool:
        """True if ``condition`` becomes true within :attr:`patience_s`: for what must not happen."""
        return self.wait(condition, self.patience_s)

    # -- what is sent

    def send(self, channel: c.Channel, value: object) -> float:
        """Publish a command, as bytes or as its struct; return the time of sending (monotonic)."""
        payload = value if isinstance(value, bytes) else codec.encode(channel, value)
        self.transport.publish(channel.topic(self.base), payload, qos=QoS(channel.default_qos), urgent=True)
        return time.monotonic()

    def sent(self, seconds: float) -> float:
        """Wait up to ``seconds`` until the broker has acknowledged all commands; return the time then (monotonic)."""
        self.wait(lambda: self.transport.outgoing.waiting == 0, seconds)
        return time.monotonic()

    def send_as(self, account: str, channel: c.Channel, value: object) -> bool:
        """Publish a command under another account ("": none); True if the broker delivers it."""
        payload = value if isinstance(value, bytes) else codec.encode(channel, value)
        topic = channel.topic(self.base)
        with self.beside("conform-other", f"{self.base}/{c.INCOMING}/#") as (beside, messages):
            beside.publish(with_name(topic, account) if account else topic, payload, qos=QoS.DELIVERED, urgent=True)
            return self.wait(lambda: any(message.payload == payload for message in list(messages)), _RETAINED_S)

    def retained(self) -> list[Record]:
        """Return the retained messages of the robot and for it, as a new client gets them."""
        filters = (f"{self.base}/{direction}/#" for direction in (c.OUTGOING, c.INCOMING))
        with self.beside("conform-retained", *filters) as (_, messages):
            self.look(_RETAINED_S)
        return [self.record_of(message, 0.0) for message in list(messages) if message.retain and message.payload]

    @contextmanager
    def beside(self, program: str, *filters: str) -> Iterator[tuple[Transport, deque[Message]]]:
        """Yield a second connection that reads ``filters``, and its messages. ``program``: as in :class:`Target`.

        Each filter is a subscription of its own, as some brokers refuse one filter and grant the others.
        """
        messages: deque[Message] = deque(maxlen=_MOST)
        with connected(replace(self.target, program=program)) as (beside, _):
            for filter_ in filters:
                beside.subscribe(filter_, messages.append, qos=QoS.DELIVERED, direct=True)
            yield beside, messages


@contextmanager
def observed(target: Target, seconds: float) -> Iterator[Observer]:
    """Connect, and observe for ``seconds``. Raises PebbleError."""
    with connected(target) as (transport, names):
        observer = Observer(target, transport, names)
        observer.look(seconds)
        yield observer


def why_not_free(view: RobotView) -> str:
    """Return who drives the robot or has stopped it, as a test must not interfere; empty if it is free."""
    if view.stopped_by is not None:
        return f"it is stopped by {view.stopped_by.by or 'unknown'}, which only a person ends"
    if view.autonomy is not None and view.autonomy.running:
        return f"the script {view.autonomy.file} is running"
    return f"{view.control.who} drives it" if view.control.who else ""


def available(capabilities: dict[str, Any]) -> Iterator[str]:
    """Return the sections of a robot's capabilities that are available."""
    return (name for name in capabilities if section_of(capabilities, name).get("available") is True)
