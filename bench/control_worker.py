"""One end of the control comparison as a process: ``python -m pebble.bench.control_worker echo|sender ENDPOINT``.

``ENDPOINT`` (JSON) names the broker or hub. The process writes ``{"ready": true}``. A sender receives slices as JSON
and answers each.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import msgspec

from pebble.bench.control_ends import Connection, Echo, PahoConnection, Sender, SliceSpec, TransportConnection
from pebble.errors import PebbleError
from pebble.rig.worker_end import answer, serve_on_thread
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
    ended = serve_on_thread(lambda _line: None, lambda: inbox.post_internal(lambda: None))
    answer({"ready": True})
    while not ended.is_set():
        _work(inbox)
    connection.close()


def _send(connection: Connection, inbox: Inbox) -> None:
    sender = Sender(connection, WHO, time.monotonic_ns, inbox)

    def run(line: str) -> None:
        inbox.post_internal(lambda: answer(msgspec.json.encode(_run(sender, line))))

    def end() -> None:
        sender.ended = True
        inbox.post_internal(lambda: None)

    serve_on_thread(run, end)
    if not sender.warm_up(_WARM_UP, _WARM_UP_S):
        raise PebbleError("the echo does not answer")
    answer({"ready": True})
    while not sender.ended:
        _work(inbox)
    connection.close()


def _work(inbox: Inbox) -> None:
    job = inbox.take(None)
    if job is not None:
        job()


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


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
