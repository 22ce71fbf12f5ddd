"""The two ends of the control comparison, which use a transport as services do.

Both handle a message on the transport's thread that receives it, like an idle service with a drive command, and like
stock paho.

``python -m pebble.extensions.lab.bench.control_ends echo|sender stand-in|mqtt|zenoh SETTINGS`` (JSON, for the
transport). A sender receives slices (messages of one size at one rate, for some time) as JSON and answers each.
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
from typing import Any, NamedTuple

import msgspec

from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.results import STAND_IN
from pebble.extensions.lab.rig.worker_end import answer, serve
from pebble.transports import MqttSettings, QoS, State, Transport, ZenohSettings, create

REQUESTS, REPLIES = "pebble/bench/echo", "pebble/bench/echoed"
_QOS = QoS(DRIVE.default_qos)
_LEAD_S = 0.1  # messages at the start of a slice do not count: caches are cold after a pause
_LAST_S = 1.0  # how long to wait for the last replies of a slice
_POLL_S = 0.01
_CONNECT_S = 10.0
_WARM_UP, _WARM_UP_S = 20, 15.0  # messages

#: A message: its number, when it was sent (ns), and when it was echoed (ns); padding follows.
_FORM = struct.Struct("<Qqq")
_ECHOED, _ECHOED_AT = struct.Struct("<q"), 16  # the third value, and its place in bytes
SMALLEST = _FORM.size

Handler = Callable[[bytes], None]


class SliceSpec(msgspec.Struct, frozen=True):
    """A slice of a round: messages of this size at this rate."""

    size: int
    rate: float
    seconds: float


class Slice(msgspec.Struct, frozen=True):
    """The results of a slice, the messages that a :class:`SliceSpec` describes."""

    sent: int  # counted messages
    latencies_us: list[float]  # of those that were echoed


# -- connections, and the two ends


class Connection(NamedTuple):
    """The three functions of a connection that the benchmark uses."""

    subscribe: Callable[[str, Handler], object]  # to a topic
    publish: Callable[[str, bytes], object]
    close: Callable[[], object]


def opened(transport: Transport) -> Connection:
    """Open any of Pebble's transports; return the functions that pebble.service.Service uses. Raises PebbleError."""
    transport.open(_CONNECT_S)
    if transport.state is not State.CONNECTED:
        problem = transport.problem
        transport.close()
        raise PebbleError(f"no connection: {problem or 'no answer'}")

    def subscribe(topic: str, handler: Handler) -> None:
        transport.subscribe(topic, lambda message: handler(message.payload), qos=_QOS, direct=True)

    return Connection(subscribe, partial(transport.publish, qos=_QOS), transport.close)


def stock(port: int) -> Connection:
    """Open stock paho with its own network thread and no socket options, as in the original program."""
    from pebble.extensions.lab.bench.clients import StockClient  # only these ends import paho

    client = StockClient(at_once=False).open(port)
    client.wait()

    def subscribe(topic: str, handler: Handler) -> None:
        client.paho.on_message = lambda _client, _data, message: handler(bytes(message.payload))
        client.subscribe(topic, _QOS)

    return Connection(subscribe, partial(client.paho.publish, qos=_QOS), client.close)


def echo(connection: Connection) -> None:
    """Return every message to its sender at once, with the time of its arrival."""

    def on_message(payload: bytes) -> None:
        reply = bytearray(payload)
        _ECHOED.pack_into(reply, _ECHOED_AT, time.monotonic_ns())
        connection.publish(REPLIES, bytes(reply))

    connection.subscribe(REQUESTS, on_message)


class Sender:
    """A sender of slices. It makes an entry for each message, which the transport's thread fills from the reply."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._first = 0  # the number of the first message
        self._received: list[float | None] = []  # by message: its latency in µs
        connection.subscribe(REPLIES, self._on_message)

    def warm_up(self, count: int, timeout: float) -> bool:
        """Exchange ``count`` messages, so that both ends are connected and their code has run; False if that fails."""
        end, returned = time.monotonic() + timeout, 0
        while returned < count and time.monotonic() < end:
            self._expect(1)
            self._send(self._first, SMALLEST)
            if self._collect(0.1):
                returned += 1
        return returned >= count

    def run(self, spec: SliceSpec) -> Slice:
        """Send the messages of a slice at their times; return its results once all replies are there, or are lost."""
        lead, period = max(1, math.ceil(_LEAD_S * spec.rate)), 1 / spec.rate
        counted = max(1, round(spec.seconds * spec.rate))
        self._expect(lead + counted)
        due = time.monotonic() + period
        for number in range(lead + counted):
            time.sleep(max(0.0, due - time.monotonic()))
            self._send(self._first + number, spec.size)
            due += period
        self._collect(_LAST_S)
        return Slice(counted, [latency_us for latency_us in self._received[lead:] if latency_us is not None])

    def _expect(self, count: int) -> None:
        """Make entries for the next ``count`` messages, whose numbers continue those of earlier messages."""
        self._first += len(self._received)
        self._received = [None] * count

    def _send(self, number: int, size: int) -> None:
        self._connection.publish(REQUESTS, _FORM.pack(number, time.monotonic_ns(), 0).ljust(size, b"\0"))

    def _collect(self, timeout: float) -> bool:
        """Wait for the replies, at most ``timeout`` seconds; return True if all are there."""
        end = time.monotonic() + timeout
        while None in self._received and time.monotonic() < end:
            time.sleep(_POLL_S)
        return None not in self._received

    def _on_message(self, payload: bytes) -> None:
        number, sent_ns, echoed_ns = _FORM.unpack_from(payload)
        index = number - self._first
        if 0 <= index < len(self._received) and self._received[index] is None:  # QoS 1 may deliver twice
            self._received[index] = (echoed_ns - sent_ns) / 1000


def run_end(role: str, kind: str, settings: str) -> None:
    """Run one end until standard input closes. The arguments are those of the command line."""
    form = ZenohSettings if kind == "zenoh" else MqttSettings
    where: Any = msgspec.json.decode(settings, type=form, dec_hook=lambda _kind, text: Path(text))
    connection = stock(where.port) if kind == STAND_IN else opened(create(kind, role, where))
    with closing(connection):
        if role == "echo":
            echo(connection)
            answer({"ready": True})
            serve(lambda _line: None)
        else:
            sender = Sender(connection)
            if not sender.warm_up(_WARM_UP, _WARM_UP_S):
                raise PebbleError("the echo does not answer")
            answer({"ready": True})
            serve(lambda line: msgspec.json.encode(sender.run(msgspec.json.decode(line, type=SliceSpec))))


if __name__ == "__main__":
    run_end(*sys.argv[1:])
