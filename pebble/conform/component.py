"""One component as any client at its broker sees it: everything it publishes, and what is sent to it."""

import secrets
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from pebble import contract as c
from pebble.client.connection import Target, connected, put_names
from pebble.client.names import Names
from pebble.client.robot_view import RobotView
from pebble.contract import channel_of, codec
from pebble.contract.names import with_name
from pebble.contract.payloads import ControlRequest
from pebble.errors import PayloadError
from pebble.transports import Message, QoS, Transport

ANSWER_S = 1.0  # within which a robot answers
_STEP_S = 0.005
_MOST = 50_000  # messages that are kept; a robot at rest sends some ten a second
_RETAINED_S = 1.0  # some brokers send what is retained a moment after the subscription


@dataclass(frozen=True, slots=True)
class Record:
    """One message, when it arrived (monotonic), and its value by the contract; ``wrong``: why it has none."""

    at: float
    metric: str  # below the base: ``outgoing/online``
    payload: bytes
    retain: bool
    channel: c.Channel | None
    value: Any = None
    wrong: str = ""


class Component:
    """What arrived of one component. :meth:`wait` lets time pass and reads it."""

    def __init__(self, target: Target, transport: Transport, names: Names, base: str) -> None:
        self.base = base
        self.ask = ask_person  # tells the person at the robot what to do
        self.person_s = 180.0  # until that is done, and a broker has noticed it: 1.5 times a keep-alive of a minute
        self.records: deque[Record] = deque(maxlen=_MOST)
        self._of: defaultdict[c.Channel | None, deque[Record]] = defaultdict(lambda: deque(maxlen=_MOST))
        self.stalled_s = 0.0  # the longest time that this program waited in vain to go on
        self._slowest_s = ANSWER_S / 4  # of its answers
        #: When its wheels changed (monotonic), and to what, left and right: from where it is seen besides.
        self.eyes: Callable[[], list[tuple[float, list[float]]]] = list
        self.view = RobotView(base)
        self._target, self._transport, self.account = target, transport, names.account
        self._arrived: deque[tuple[Message, float, float]] = deque(maxlen=_MOST)
        put_names(transport, names, lambda of: of == base and self.view.named)
        transport.subscribe(f"{base}/{c.OUTGOING}/#", self._take, qos=QoS.DELIVERED, direct=True)

    def _take(self, message: Message) -> None:
        self._arrived.append((message, time.monotonic(), time.time()))

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Read what arrives until ``condition``; False: not within ``seconds``."""
        end = time.monotonic() + seconds
        while True:
            while self._arrived:
                message, at, wall = self._arrived.popleft()
                record = record_of(message, self.base, at)
                self.records.append(record)
                self._of[record.channel].append(record)
                self.view.receive(record.channel, message, at, wall)
            if condition():
                return True
            if time.monotonic() >= end:
                return False
            slept = time.monotonic()
            time.sleep(_STEP_S)
            self.stalled_s = max(self.stalled_s, time.monotonic() - slept)

    def look(self, seconds: float) -> float:
        """Only let time pass; returns when that began."""
        began = time.monotonic()
        self.wait(lambda: False, seconds)
        return began

    def answers(self, condition: Callable[[], object]) -> bool:
        """Whether the robot does what was asked, in time."""
        began = time.monotonic()
        done = self.wait(condition, ANSWER_S)
        if done:
            self._slowest_s = max(self._slowest_s, time.monotonic() - began)
        return done

    @property
    def patience_s(self) -> float:
        """How long one must look on to be sure that something does not happen: it may answer late, here or always."""
        return 2 * self._slowest_s

    def happens(self, condition: Callable[[], object]) -> bool:
        """Whether the robot does what it must not do."""
        return self.wait(condition, self.patience_s)

    def of(self, channel: c.Channel, since: float = 0.0, *, retained: bool = False) -> list[Record]:
        """Its live messages of a channel, or with ``retained`` all."""
        return [one for one in self._of[channel] if one.at >= since and one.payload and (retained or not one.retain)]

    def send(self, channel: c.Channel, value: object) -> float:
        """Publish a command, as bytes or as its struct; returns when."""
        payload = value if isinstance(value, bytes) else codec.encode(channel, value)
        self._transport.publish(channel.topic(self.base), payload, qos=QoS(channel.default_qos), urgent=True)
        return time.monotonic()

    def sent(self, seconds: float) -> float:
        """Wait until the broker has all that was sent, so long at most; returns when."""
        self.wait(lambda: self._transport.outgoing.waiting == 0, seconds)
        return time.monotonic()

    def retain(self, channel: c.Channel, payload: bytes) -> None:
        """Leave a command at the broker; empty bytes remove it. It bears no name: nothing with one is retained."""
        with connected(self._target) as (beside, _):
            beside.publish(channel.topic(self.base), payload, qos=QoS.DELIVERED, retain=True, remember=False)
            self.wait(lambda: beside.outgoing.waiting == 0, _RETAINED_S)

    def send_as(self, account: str, channel: c.Channel, value: object) -> bool:
        """Publish a command with another account in its topic, or "": without one; whether the broker delivers it."""
        payload = value if isinstance(value, bytes) else codec.encode(channel, value)
        topic = channel.topic(self.base)
        found: deque[Message] = deque(maxlen=_MOST)
        with connected(replace(self._target, program="conform-other")) as (beside, _):
            beside.subscribe(f"{self.base}/{c.INCOMING}/#", found.append, qos=QoS.DELIVERED, direct=True)
            beside.publish(with_name(topic, account) if account else topic, payload, qos=QoS.DELIVERED, urgent=True)
            return self.wait(lambda: any(one.payload == payload for one in list(found)), _RETAINED_S)

    def reads_commands(self) -> bool:
        """Whether this client may read what is sent to the robot: a request that changes nothing comes back."""
        request = ControlRequest(id=secrets.token_hex(4), want="release")
        found: deque[Message] = deque(maxlen=_MOST)
        with connected(replace(self._target, program="conform-commands")) as (beside, _):
            beside.subscribe(f"{self.base}/{c.INCOMING}/#", found.append, qos=QoS.DELIVERED, direct=True)
            self.send(c.CONTROL, request)
            return self.wait(lambda: any(request.id.encode() in one.payload for one in list(found)), _RETAINED_S)

    def retained(self) -> list[Record]:
        """What the broker has retained of it and for it, as one gets it who connects now."""
        found: deque[Message] = deque(maxlen=_MOST)
        with connected(replace(self._target, program="conform-retained")) as (beside, _):
            for direction in (c.OUTGOING, c.INCOMING):  # of which some brokers refuse one
                beside.subscribe(f"{self.base}/{direction}/#", found.append, qos=QoS.DELIVERED, direct=True)
            self.wait(lambda: False, _RETAINED_S)
        return [record_of(one, self.base, 0.0) for one in list(found) if one.retain and one.payload]


def ask_person(text: str) -> None:
    print(f"pebble: {text}", file=sys.stderr, flush=True)  # noqa: T201 - standard output is for the result


def record_of(message: Message, base: str, at: float) -> Record:
    metric = message.topic.removeprefix(f"{base}/")
    channel = channel_of(metric)
    record = Record(at, metric, message.payload, message.retain, channel)
    if channel is None or not message.payload:
        return record
    try:
        return replace(record, value=codec.decode(channel, message.payload))
    except PayloadError as error:
        return replace(record, wrong=str(error))


@contextmanager
def reached(target: Target, seconds: float) -> Iterator[Component]:
    """Connect, and look on for so long. Raises PebbleError."""
    with connected(target) as (transport, names):
        component = Component(target, transport, names, names.base)
        component.look(seconds)
        yield component
