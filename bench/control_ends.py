"""The two ends of the control comparison, a periodic sender and an echo, which use a transport as services do.

A service handles a drive command on the transport's thread that brings it, if it is idle; else its inbox keeps the
command for its own thread (decision 24). These do the same. Stock paho calls its handler on its network thread.

As a process: ``python -m pebble.bench.control_ends echo|sender paho|mqtt|zenoh SETTINGS`` (JSON, of the transport). It
writes ``{"ready": true}``. A sender receives slices as JSON and answers each.
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
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from pebble.bench.null import spin
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.runtime.inbox import Inbox
from pebble.runtime.work_lock import WorkLock
from pebble.transports import Message, MqttSettings, QoS, State, Transport, ZenohSettings, create

if TYPE_CHECKING:
    from pebble.bench.comparison import Case

ONE_WAY, ROUND_TRIP = "one-way", "round trip"  # measures
REQUESTS, REPLIES = "pebble/bench/echo", "pebble/bench/echoed"  # followed by the sender's name
QOS = QoS(DRIVE.default_qos)
_LEAD_S = 0.1  # messages at the start of a slice do not count: caches are cold after a pause
_LAST_S = 1.0  # how long to wait for the last replies of a slice
_POLL_S = 0.01
_CONNECT_S = 10.0
_WHO = "bench"  # the sender's name
_WARM_UP, _WARM_UP_S = 20, 15.0  # messages

_FORM = struct.Struct("<Qqqq")
_ECHOED = struct.Struct("<qq")
_ECHOED_AT = 16  # behind the number and the first stamp
SMALLEST = _FORM.size

Handler = Callable[[str, bytes, int], None]  # topic, payload, and when the transport received it (ns)
Clock = Callable[[], int]  # ns


class SliceSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One slice: messages of this size at this rate."""

    size: int
    rate: float
    seconds: float
    work_us: float = 0.0  # of busy work at each message: before its time stamp,
    slowed: bool = False  # or, if slowed, between time stamp and publish call

    @staticmethod
    def of(case: Case) -> SliceSpec:
        """The slice of a case, whose condition has the :func:`size_name` and the :func:`rate_name`."""
        number, unit = str(case.condition["size"]).split()
        return SliceSpec(
            size=int(number) * (1024 if unit == "KB" else 1),
            rate=float(str(case.condition["rate"]).split()[0]),
            seconds=case.run["seconds"],
            work_us=case.planted_us,
            slowed=case.slowed,
        )


def size_name(size: int) -> str:
    return f"{size // 1024} KB" if size % 1024 == 0 else f"{size} B"


def rate_name(rate: float) -> str:
    return f"{rate:g} Hz"


# -- messages: a number, three time stamps, and padding to the requested size


class Exchange(NamedTuple):
    """NTP's four stamps in ns. Near clock: t1 (sent) and t4 (received). Far clock: t2 (received) and t3 (sent)."""

    t1: int
    t2: int
    t3: int
    t4: int
    transport_ns: int = 0  # before t4: when the near transport received it


def request(number: int, t1: int, size: int) -> bytes:
    return _FORM.pack(number, t1, 0, 0).ljust(size, b"\0")


def stamped(payload: bytes, t2: int, t3: int) -> bytes:
    """The same message with the echo's stamps, of the same length: at least :data:`SMALLEST`."""
    message = bytearray(payload)
    _ECHOED.pack_into(message, _ECHOED_AT, t2, t3)
    return bytes(message)


def parse(payload: bytes) -> tuple[int, ...]:
    """Number, t1, t2, t3, of at least :data:`SMALLEST` bytes."""
    return _FORM.unpack_from(payload)


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

        transport.subscribe(filter_, on_message, qos=QOS, direct=True)

    return Connection(subscribe, partial(transport.publish, qos=QOS), transport.close)


def stock(port: int) -> Connection:
    """Stock paho with its own network thread and no socket options, as in the original program."""
    from pebble.bench.drivers import StockClient  # only these ends import paho

    client = StockClient(at_once=False).open(port)
    client.wait()

    def subscribe(filter_: str, handler: Handler) -> None:
        def on_message(_client: Any, _data: Any, message: Any) -> None:
            handler(message.topic, message.payload, time.monotonic_ns())

        client.paho.on_message = on_message
        client.subscribe(filter_, QOS)

    return Connection(subscribe, partial(client.paho.publish, qos=QOS), client.close)


class Echo:
    """Returns every message for ``who`` (``+`` for all) at once, with its own time stamps."""

    def __init__(self, connection: Connection, who: str, clock: Clock) -> None:
        self.count = 0
        self._connection, self._clock = connection, clock
        connection.subscribe(f"{REQUESTS}/{who}", self._on_message)

    def _on_message(self, topic: str, payload: bytes, _transport_ns: int) -> None:
        received = self._clock()
        if len(payload) >= SMALLEST:  # else a foreign message on a shared broker
            reply = stamped(payload, received, self._clock())
            self._connection.publish(REPLIES + topic.removeprefix(REQUESTS), reply)
            self.count += 1


class Sender:
    """Sends slices and collects the replies; what collects on another thread fills entries that the slice has made."""

    def __init__(self, connection: Connection, who: str, clock: Clock, desk: Desk) -> None:
        self._connection, self._clock, self._desk = connection, clock, desk
        self._topic = f"{REQUESTS}/{who}"
        self._next = self._first = self._missing = 0
        self._received: list[Exchange | None] = []
        self._calls: list[int] = []
        self.trips = 0  # in the last slice
        self.calls_ns: list[int] = []  # durations of its publish calls
        self.ended = False
        connection.subscribe(f"{REPLIES}/{who}", self._on_message)

    def warm_up(self, count: int, timeout: float) -> bool:
        """Exchanges ``count`` messages, so that both ends are connected and their code has run; False if that fails."""
        end, returned = time.monotonic() + timeout, 0
        while returned < count and time.monotonic() < end and not self.ended:
            self._expect(1)
            with self._desk.lock:
                self._send(self._first, SliceSpec(size=40, rate=1, seconds=1))
            self._collect(0.1)
            returned += not self._missing
        return returned >= count

    def run(self, spec: SliceSpec) -> tuple[int, int, list[Exchange]]:
        """Runs one slice; returns the number of counted messages, how many of them were late, and the exchanges.

        Late means by more than half of the period.
        """
        lead, period = max(1, math.ceil(_LEAD_S * spec.rate)), 1 / spec.rate
        counting = max(1, round(spec.seconds * spec.rate))
        self._expect(lead + counting)
        sent = late = 0
        due = time.monotonic() + period
        while sent < lead + counting and not self.ended:
            self._desk.turn(max(0.0, due - time.monotonic()))
            behind = time.monotonic() - due
            if behind >= 0:
                late += sent >= lead and behind > period / 2
                with self._desk.lock:
                    self._send(self._first + sent, spec)
                sent, due = sent + 1, due + period
        self._collect(_LAST_S)
        self.trips, self.calls_ns = sent, self._calls[lead:]
        return counting, late, [exchange for exchange in self._received[lead:] if exchange is not None]

    def _expect(self, count: int) -> None:
        self._first, self._next = self._next, self._next + count
        self._received, self._missing, self._calls = [None] * count, count, []

    def _send(self, number: int, spec: SliceSpec) -> None:
        spin(0.0 if spec.slowed else spec.work_us)
        message = request(number, self._clock(), spec.size)
        spin(spec.work_us if spec.slowed else 0.0)
        called = time.monotonic_ns()
        self._connection.publish(self._topic, message)
        self._calls.append(time.monotonic_ns() - called)

    def _collect(self, timeout: float) -> None:
        end = time.monotonic() + timeout
        while self._missing and time.monotonic() < end and not self.ended:
            self._desk.turn(_POLL_S)

    def _on_message(self, _topic: str, payload: bytes, transport_ns: int) -> None:
        received = self._clock()
        if len(payload) < SMALLEST:
            return
        number, t1, t2, t3 = parse(payload)
        index = number - self._first
        if 0 <= index < len(self._received) and self._received[index] is None:  # QoS 1 may deliver twice
            self._received[index] = Exchange(t1, t2, t3, received, transport_ns)
            self._missing -= 1


# -- one of them as a process


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """The results of a slice, µs."""

    trips: int  # all messages sent
    sent: int  # counted messages
    late: int
    one_way: list[float]
    round_trip: list[float]
    call: list[float]  # durations of this end's publish calls
    transport_times: list[float]  # from the echo's publish call until this end's transport received the reply
    inbox: list[float]  # from then until its handler ran


def _echo(connection: Connection, desk: Desk) -> None:
    Echo(connection, _WHO, time.monotonic_ns)
    ended = serve_on_thread(lambda _line: None, desk.inbox.wake)
    answer({"ready": True})
    while not ended.is_set():
        desk.turn()


def _send(connection: Connection, desk: Desk) -> None:
    sender, lines = Sender(connection, _WHO, time.monotonic_ns, desk), SimpleQueue[str]()

    def end() -> None:
        sender.ended = True
        desk.inbox.wake()
        lines.put("")

    serve_on_thread(lines.put, end)
    if not sender.warm_up(_WARM_UP, _WARM_UP_S):
        raise PebbleError("the echo does not answer")
    answer({"ready": True})
    while line := lines.get():
        sent, late, exchanges = sender.run(msgspec.json.decode(line, type=SliceSpec))
        done = Answer(
            trips=sender.trips,
            sent=sent,
            late=late,
            one_way=[(one.t2 - one.t1) / 1000 for one in exchanges],
            round_trip=[(one.t4 - one.t1) / 1000 for one in exchanges],
            call=[ns / 1000 for ns in sender.calls_ns],
            transport_times=[(one.transport_ns - one.t3) / 1000 for one in exchanges],
            inbox=[(one.t4 - one.transport_ns) / 1000 for one in exchanges],
        )
        answer(msgspec.json.encode(done))


def main(role: str, kind: str, settings: str) -> None:
    desk, form = Desk(), ZenohSettings if kind == "zenoh" else MqttSettings
    where: Any = msgspec.json.decode(settings, type=form, dec_hook=lambda _kind, text: Path(text))
    try:
        paho = kind == "paho"
        with closing(stock(where.port) if paho else opened(create(kind, role, where), desk)) as connection:
            (_echo if role == "echo" else _send)(connection, desk)
    except PebbleError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(*sys.argv[1:])
