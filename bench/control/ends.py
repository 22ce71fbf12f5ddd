"""The two ends of the control comparison, which use a transport as services do.

A service handles a drive command on the transport's thread that brings it, if it is idle; else its inbox keeps the
command for its own thread (decision 24). The ends do the same. Stock paho calls its handler on its network thread.

``python -m pebble.bench.control.ends echo|sender paho|mqtt|zenoh SETTINGS`` (JSON, of the transport). A sender
receives slices as JSON and answers each.
"""

from __future__ import annotations

import math
import struct
import sys
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from pebble.bench.judging.null import spin
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.worker_end import answer, serve, serve_on_thread
from pebble.runtime.inbox import Inbox
from pebble.runtime.work_lock import WorkLock
from pebble.transports import Message, MqttSettings, QoS, State, Transport, ZenohSettings, create

if TYPE_CHECKING:
    from pebble.bench.comparison import Case
    from pebble.bench.results import Value

ONE_WAY, ROUND_TRIP = "one-way", "round trip"  # measures
REQUESTS, REPLIES = "pebble/bench/echo", "pebble/bench/echoed"  # followed by the sender's name
_QOS = QoS(DRIVE.default_qos)
_LEAD_S = 0.1  # messages at the start of a slice do not count: caches are cold after a pause
_LAST_S = 1.0  # how long to wait for the last replies of a slice
_POLL_S = 0.01
_CONNECT_S = 10.0
_WHO = "bench"  # the sender's name
_WARM_UP, _WARM_UP_S = 20, 15.0  # messages

_FORM = struct.Struct("<Qqqq")  # of a message: its number and t1 to t3; padding follows
_ECHOED, _ECHOED_AT = struct.Struct("<qq"), 16  # t2 and t3
SMALLEST = _FORM.size

Handler = Callable[[str, bytes, int], None]  # topic, payload, and when the transport received it (ns)
Clock = Callable[[], int]  # ns


class SliceSpec(msgspec.Struct, frozen=True):
    """One slice: messages of this size at this rate."""

    size: int
    rate: float
    seconds: float
    work_us: float = 0.0  # of busy work at each message: before its time stamp,
    slowed: bool = False  # or, if slowed, between time stamp and publish call

    @staticmethod
    def of(case: Case) -> SliceSpec:
        """The slice of a case with a :func:`condition`."""
        (number, unit), (rate, _) = (str(case.condition[name]).split() for name in ("size", "rate"))
        size = int(number) * (1024 if unit == "KB" else 1)
        return SliceSpec(size, float(rate), case.run["seconds"], case.planted_us, case.slowed)


def condition(size: int, rate: float) -> dict[str, Value]:
    """``{"size": "1 KB", "rate": "20 Hz"}``"""
    return {"size": f"{size // 1024} KB" if size % 1024 == 0 else f"{size} B", "rate": f"{rate:g} Hz"}


class Exchange(NamedTuple):
    """NTP's four stamps in ns. Near clock: t1 (sent) and t4 (received). Far clock: t2 (received) and t3 (sent)."""

    t1: int
    t2: int
    t3: int
    t4: int
    transport_ns: int = 0  # before t4: when the near transport received it


class Slice(msgspec.Struct, frozen=True, kw_only=True):
    """The results of a slice."""

    trips: int  # all messages sent
    sent: int  # counted messages
    late: int  # of these, by more than half of the period
    calls_ns: list[int]  # durations of their publish calls
    exchanges: list[Exchange]


# -- connections, and the two ends


class Connection(NamedTuple):
    """What one end does with its connection."""

    subscribe: Callable[[str, Handler], object]  # to a filter
    publish: Callable[[str, bytes], object]  # to a topic
    close: Callable[[], object]


class Desk:
    """The inbox of one end, and the lock under which it works."""

    def __init__(self) -> None:
        self.inbox, self.lock = Inbox(), WorkLock()

    def bring(self, job: Callable[[], None]) -> None:
        """As Service.run_if_idle; posted if the end is busy."""
        if self.lock.try_enter():
            try:
                if not self.inbox:
                    return job()
            finally:
                self.lock.leave()
        return self.inbox.post(job)

    def turn(self, timeout: float | None = None) -> None:
        """Does the next job that waits, waiting up to ``timeout`` seconds for one."""
        self.inbox.wait(timeout)
        with self.lock:
            job = self.inbox.take()
            if job is not None:
                job()


def opened(transport: Transport, desk: Desk) -> Connection:
    """Any of Pebble's transports, used through the same calls as in pebble.service.Service. Raises PebbleError."""
    transport.open(_CONNECT_S)
    if transport.state is not State.CONNECTED:
        problem = transport.problem
        transport.close()
        raise PebbleError(f"no connection: {problem or 'no answer'}")

    def subscribe(filter_: str, handler: Handler) -> None:
        def on_message(message: Message) -> None:
            received_ns = time.monotonic_ns()
            desk.bring(lambda: handler(message.topic, message.payload, received_ns))

        transport.subscribe(filter_, on_message, qos=_QOS, direct=True)

    return Connection(subscribe, partial(transport.publish, qos=_QOS), transport.close)


def stock(port: int) -> Connection:
    """Stock paho with its own network thread and no socket options, as in the original program."""
    from pebble.bench.clients import StockClient  # only these ends import paho

    client = StockClient(at_once=False).open(port)
    client.wait()

    def subscribe(filter_: str, handler: Handler) -> None:
        client.paho.on_message = lambda _client, _data, one: handler(one.topic, bytes(one.payload), time.monotonic_ns())
        client.subscribe(filter_, _QOS)

    return Connection(subscribe, partial(client.paho.publish, qos=_QOS), client.close)


def echo(connection: Connection, who: str, clock: Clock) -> None:
    """From now on returns every message for ``who`` (``+`` for all) at once, with time stamps of its own."""

    def on_message(topic: str, payload: bytes, _transport_ns: int) -> None:
        received = clock()
        if len(payload) >= SMALLEST:  # else a foreign message on a shared broker
            reply = bytearray(payload)
            _ECHOED.pack_into(reply, _ECHOED_AT, received, clock())
            connection.publish(REPLIES + topic.removeprefix(REQUESTS), bytes(reply))

    connection.subscribe(f"{REQUESTS}/{who}", on_message)


class Sender:
    """Sends slices and collects the replies; what collects on another thread fills entries that the slice has made."""

    def __init__(self, connection: Connection, who: str, clock: Clock, desk: Desk) -> None:
        self._connection, self._clock, self._desk = connection, clock, desk
        self._topic = f"{REQUESTS}/{who}"
        self._first = 0  # the number of the first message
        self._received: list[Exchange | None] = []
        self._calls_ns: list[int] = []
        connection.subscribe(f"{REPLIES}/{who}", self._on_message)

    def warm_up(self, count: int, timeout: float) -> bool:
        """Exchanges ``count`` messages, so that both ends are connected and their code has run; False if that fails."""
        end, returned = time.monotonic() + timeout, 0
        while returned < count and time.monotonic() < end:
            self._expect(1)
            with self._desk.lock:
                self._send(self._first, SliceSpec(size=40, rate=1, seconds=1))
            self._collect(0.1)
            returned += None not in self._received
        return returned >= count

    def run(self, spec: SliceSpec) -> Slice:
        lead, period = max(1, math.ceil(_LEAD_S * spec.rate)), 1 / spec.rate
        counting = max(1, round(spec.seconds * spec.rate))
        self._expect(lead + counting)
        sent = late = 0
        due = time.monotonic() + period
        while sent < lead + counting:
            self._desk.turn(max(0.0, due - time.monotonic()))
            behind = time.monotonic() - due
            if behind >= 0:
                late += sent >= lead and behind > period / 2
                with self._desk.lock:
                    self._send(self._first + sent, spec)
                sent, due = sent + 1, due + period
        self._collect(_LAST_S)
        exchanges = [exchange for exchange in self._received[lead:] if exchange is not None]
        return Slice(trips=sent, sent=counting, late=late, calls_ns=self._calls_ns[lead:], exchanges=exchanges)

    def _expect(self, count: int) -> None:
        self._first += len(self._received)
        self._received, self._calls_ns = [None] * count, []

    def _send(self, number: int, spec: SliceSpec) -> None:
        spin(0.0 if spec.slowed else spec.work_us)
        message = _FORM.pack(number, self._clock(), 0, 0).ljust(spec.size, b"\0")
        spin(spec.work_us if spec.slowed else 0.0)
        called = time.monotonic_ns()
        self._connection.publish(self._topic, message)
        self._calls_ns.append(time.monotonic_ns() - called)

    def _collect(self, timeout: float) -> None:
        end = time.monotonic() + timeout
        while None in self._received and time.monotonic() < end:
            self._desk.turn(_POLL_S)

    def _on_message(self, _topic: str, payload: bytes, transport_ns: int) -> None:
        received = self._clock()
        if len(payload) < SMALLEST:
            return
        number, t1, t2, t3 = _FORM.unpack_from(payload)
        index = number - self._first
        if 0 <= index < len(self._received) and self._received[index] is None:  # QoS 1 may deliver twice
            self._received[index] = Exchange(t1, t2, t3, received, transport_ns)


def run_end(role: str, kind: str, settings: str) -> None:
    desk, form = Desk(), ZenohSettings if kind == "zenoh" else MqttSettings
    where: Any = msgspec.json.decode(settings, type=form, dec_hook=lambda _kind, text: Path(text))
    with closing(stock(where.port) if kind == "paho" else opened(create(kind, role, where), desk)) as connection:
        if role == "echo":
            echo(connection, _WHO, time.monotonic_ns)
            ended = serve_on_thread(lambda _line: None, desk.inbox.wake)
            answer({"ready": True})
            while not ended.is_set():
                desk.turn()
        else:
            sender = Sender(connection, _WHO, time.monotonic_ns, desk)
            if not sender.warm_up(_WARM_UP, _WARM_UP_S):
                raise PebbleError("the echo does not answer")
            answer({"ready": True})
            serve(lambda line: msgspec.json.encode(sender.run(msgspec.json.decode(line, type=SliceSpec))))


if __name__ == "__main__":
    run_end(*sys.argv[1:])
