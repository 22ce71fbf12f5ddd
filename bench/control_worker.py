"""One end of the control comparison as a process: ``python -m pebble.bench.control_worker echo|sender ENDPOINT``.

``ENDPOINT`` (JSON) names the broker or hub. The process writes ``{"ready": true}`` to standard output. A sender
receives slices as JSON lines on standard input and answers each with one line. Both end when standard input closes.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from pebble.bench.control_ends import Connection, Echo, PahoConnection, Sender, SliceSpec, TransportConnection
from pebble.errors import PebbleError
from pebble.runtime.inbox import Inbox
from pebble.transports import MqttSettings, ZenohSettings, create

WHO = "bench"
_WARM_UP = 20  # messages
_WARM_UP_S = 15.0


class Endpoint(msgspec.Struct, frozen=True, kw_only=True):
    """What an end connects to: a broker's port or a robot's run directory."""

    kind: str  # "paho", "mqtt", "zenoh"
    port: int = 0
    protocol: str = "3.1.1"
    run_dir: str = ""
    client: bool = False


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


def main(arguments: list[str]) -> int:
    role, endpoint = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    inbox = Inbox()
    try:
        connection = open_connection(msgspec.json.decode(endpoint, type=Endpoint), role, inbox)
        (_echo if role == "echo" else _send)(connection, inbox)
    except PebbleError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def open_connection(endpoint: Endpoint, name: str, inbox: Inbox) -> Connection:
    """Raises PebbleError if nothing answers."""
    if endpoint.kind == "paho":
        return PahoConnection(endpoint.port)
    if endpoint.kind == "mqtt":
        settings = MqttSettings(host="127.0.0.1", port=endpoint.port, protocol=endpoint.protocol)
        return TransportConnection(create("mqtt", name, settings), inbox)
    run_dir = Path(endpoint.run_dir)
    return TransportConnection(create("zenoh", name, ZenohSettings(run_dir=run_dir, client=endpoint.client)), inbox)


def _echo(connection: Connection, inbox: Inbox) -> None:
    Echo(connection, WHO, time.monotonic_ns)
    ended = threading.Event()
    _listen(inbox, lambda _line: None, ended.set)
    _write_line(b'{"ready": true}')
    while not ended.is_set():
        job = inbox.take(None)
        if job is not None:
            job()
    connection.close()


def _send(connection: Connection, inbox: Inbox) -> None:
    sender = Sender(connection, WHO, time.monotonic_ns, inbox)

    def end() -> None:
        sender.ended = True

    _listen(inbox, lambda line: _write_line(msgspec.json.encode(_run(sender, line))), end)
    if not sender.warm_up(_WARM_UP, _WARM_UP_S):
        raise PebbleError("the echo does not answer")
    _write_line(b'{"ready": true}')
    while not sender.ended:
        job = inbox.take(None)
        if job is not None:
            job()
    connection.close()


def _run(sender: Sender, line: str) -> Answer:
    sent, late, exchanges = sender.run(msgspec.json.decode(line, type=SliceSpec))
    return Answer(
        trips=sender.trips,
        sent=sent,
        late=late,
        one_way=[(exchange.t2 - exchange.t1) / 1000 for exchange in exchanges],
        round_trip=[(exchange.t4 - exchange.t1) / 1000 for exchange in exchanges],
        call=[ns / 1000 for ns in sender.calls_ns],
        transport_times=[(exchange.transport_ns - exchange.t3) / 1000 for exchange in exchanges],
        inbox=[(exchange.t4 - exchange.transport_ns) / 1000 for exchange in exchanges],
    )


def _listen(inbox: Inbox, obey: Callable[[str], None], end: Callable[[], None]) -> None:
    """Reads standard input on a thread of its own and runs each line on the inbox's thread."""

    def read() -> None:
        for line in sys.stdin:
            inbox.post_internal(lambda line=line: obey(line))  # type: ignore[misc]
        end()
        inbox.post_internal(lambda: None)

    threading.Thread(target=read, name="orders", daemon=True).start()


def _write_line(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
