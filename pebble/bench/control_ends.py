"""The two ends of the control comparison: who sends on schedule, and who sends back; as services use a transport.

A service's handlers run on its one thread, fed by an inbox that the transport's thread posts to: so do these. Only
stock paho calls its handler on its network thread, as programs written for it expect.
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from pebble.bench.control_wire import Exchange, parse, request, stamped
from pebble.bench.null import spin
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.inbox import Inbox
from pebble.transports import Message, QoS, State, Transport

REQUESTS, REPLIES = "pebble/bench/echo", "pebble/bench/echoed"  # below them: who asks
QOS = QoS(DRIVE.default_qos)
_LEAD_S = 0.1  # messages at the begin of a slice that do not count: caches are cold after a pause
_LAST_S = 1.0  # the last replies of a slice are waited for so long
_LOOK_S = 0.01
_CONNECT_S = 10.0

Handler = Callable[[str, bytes], None]
Clock = Callable[[], int]  # ns


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """One slice: so many messages of this size, on schedule."""

    size: int
    rate: float
    seconds: float
    work_us: float = 0.0  # of work at each message: before its time stamp,
    slowed: bool = False  # or between that and the publish call


class Link(Protocol):
    """One connection of one end."""

    came_ns: int  # CLOCK_MONOTONIC: when its own thread had the message that is being handled

    def listen(self, filter_: str, handler: Handler) -> None: ...

    def publish(self, topic: str, payload: bytes) -> None: ...

    def close(self) -> None: ...


class TransportLink:
    """Any of Pebble's transports, used with the calls that pebble.service.Service uses."""

    def __init__(self, transport: Transport, inbox: Inbox) -> None:
        self.came_ns = 0
        self._transport, self._inbox = transport, inbox
        transport.open(_CONNECT_S)
        if transport.state is not State.CONNECTED:
            problem = transport.problem
            transport.close()
            raise PebbleError(f"no connection: {problem or 'nobody answers'}")

    def listen(self, filter_: str, handler: Handler) -> None:
        def hear(message: Message) -> None:
            came_ns = time.monotonic_ns()
            self._inbox.post(lambda: handle(message, came_ns))

        def handle(message: Message, came_ns: int) -> None:
            self.came_ns = came_ns
            handler(message.topic, message.payload)

        self._transport.subscribe(filter_, hear, qos=QOS, direct=True)

    def publish(self, topic: str, payload: bytes) -> None:
        self._transport.publish(topic, payload, qos=QOS)

    def close(self) -> None:
        self._transport.close()


class PahoLink:
    """Stock paho, its own network thread, no socket option: what the original does."""

    def __init__(self, port: int) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        connected, subscribed = threading.Event(), threading.Event()
        self.came_ns = 0
        self._subscribed = subscribed
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = lambda *_: connected.set()
        self._client.on_subscribe = lambda *_: subscribed.set()
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        if not connected.wait(_CONNECT_S):
            raise PebbleError(f"the broker on port {port} does not answer")

    def listen(self, filter_: str, handler: Handler) -> None:
        def hear(_client: Any, _data: Any, message: Any) -> None:
            self.came_ns = time.monotonic_ns()
            handler(message.topic, message.payload)

        self._client.on_message = hear
        self._client.subscribe(filter_, qos=QOS)
        if not self._subscribed.wait(_CONNECT_S):
            raise PebbleError(f"the broker does not answer to a subscription of {filter_}")

    def publish(self, topic: str, payload: bytes) -> None:
        self._client.publish(topic, payload, qos=QOS)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class Echo:
    """Sends back at once what is sent to ``who`` (``+`` for everybody), with its own stamps."""

    def __init__(self, link: Link, who: str, clock: Clock) -> None:
        self.count = 0
        self._link, self._clock = link, clock
        link.listen(f"{REQUESTS}/{who}", self._hear)

    def _hear(self, topic: str, payload: bytes) -> None:
        heard = self._clock()
        try:
            reply = stamped(payload, heard, self._clock())
        except struct.error:  # a stranger's message, on a broker that is not ours alone
            return
        self._link.publish(REPLIES + topic.removeprefix(REQUESTS), reply)
        self.count += 1


class Sender:
    """Sends slices and collects what comes back, on the thread that works off ``inbox``.

    Stock paho collects on a thread of its own: it only ever fills places that the slice has already made.
    """

    def __init__(self, link: Link, who: str, clock: Clock, inbox: Inbox) -> None:
        self._link, self._clock, self._inbox = link, clock, inbox
        self._topic = f"{REQUESTS}/{who}"
        self._next = self._first = self._missing = 0
        self._heard: list[Exchange | None] = []
        self._calls: list[int] = []
        self.trips = 0  # in the last slice
        self.calls_ns: list[int] = []  # how long its publish calls took
        self.ended = False
        link.listen(f"{REPLIES}/{who}", self._hear)

    def warm_up(self, count: int, timeout: float) -> bool:
        """Until ``count`` messages came back: both ends are connected, and their code has run."""
        end, came = time.monotonic() + timeout, 0
        while came < count and time.monotonic() < end and not self.ended:
            self._expect(1)
            self._send(self._first, Order(size=40, rate=1, seconds=1))
            self._collect(0.1)
            came += not self._missing
        return came >= count

    def run(self, order: Order) -> tuple[int, int, list[Exchange]]:
        """One slice: how many messages that count were sent, how many of them late, and those that came back.

        Late means by more than half of the time from one to the next.
        """
        lead, period = max(1, math.ceil(_LEAD_S * order.rate)), 1 / order.rate
        counting = max(1, round(order.seconds * order.rate))
        self._expect(lead + counting)
        sent = late = 0
        due = time.monotonic() + period
        while sent < lead + counting and not self.ended:
            self._work(max(0.0, due - time.monotonic()))
            behind = time.monotonic() - due
            if behind >= 0:
                late += sent >= lead and behind > period / 2
                self._send(self._first + sent, order)
                sent, due = sent + 1, due + period
        self._collect(_LAST_S)
        self.trips, self.calls_ns = sent, self._calls[lead:]
        return counting, late, [exchange for exchange in self._heard[lead:] if exchange is not None]

    def _expect(self, count: int) -> None:
        self._first, self._next = self._next, self._next + count
        self._heard, self._missing, self._calls = [None] * count, count, []

    def _send(self, number: int, order: Order) -> None:
        if not order.slowed:
            spin(order.work_us)
        message = request(number, self._clock(), order.size)
        if order.slowed:
            spin(order.work_us)
        called = time.monotonic_ns()
        self._link.publish(self._topic, message)
        self._calls.append(time.monotonic_ns() - called)

    def _collect(self, timeout: float) -> None:
        end = time.monotonic() + timeout
        while self._missing and time.monotonic() < end and not self.ended:
            self._work(_LOOK_S)

    def _work(self, timeout: float) -> None:
        job = self._inbox.take(timeout)
        if job is not None:
            job()

    def _hear(self, _topic: str, payload: bytes) -> None:
        heard = self._clock()
        try:
            number, t1, t2, t3 = parse(payload)
        except struct.error:
            return
        index = number - self._first
        if 0 <= index < len(self._heard) and self._heard[index] is None:  # QoS 1 may deliver twice
            self._heard[index] = Exchange(t1, t2, t3, heard, self._link.came_ns)
            self._missing -= 1
