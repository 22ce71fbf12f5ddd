"""One end of the control comparison as a process: ``python -m pebble.bench.control_worker echo|sender PLACE``.

``PLACE`` (JSON) says which fabric. It says ``{"ready": true}`` on standard output. A sender gets orders as JSON lines
on standard input and answers each with one line. Both end with their standard input.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from pebble.bench.control_ends import Echo, Link, Order, PahoLink, Sender, TransportLink
from pebble.errors import PebbleError
from pebble.inbox import Inbox
from pebble.transports import MqttSettings, ZenohSettings, create

WHO = "bench"
_WARM_UP = 20  # messages
_WARM_UP_S = 15.0


class Place(msgspec.Struct, frozen=True, kw_only=True):
    """Where an end connects: a broker's port or a robot's run directory."""

    kind: str  # "paho", "mqtt", "zenoh"
    port: int = 0
    protocol: str = "3.1.1"
    run_dir: str = ""
    client: bool = False


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a slice, µs."""

    trips: int  # all that were sent
    sent: int  # those that count
    late: int
    one_way: list[float]
    round_trip: list[float]
    call: list[float]  # the publish calls of this end
    fabric: list[float]  # from the echo's publish call until this end's transport had the reply
    inbox: list[float]  # from there until its handler ran


def main(arguments: list[str]) -> int:
    role, place = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    inbox = Inbox()
    try:
        link = open_link(msgspec.json.decode(place, type=Place), role, inbox)
        (_echo if role == "echo" else _send)(link, inbox)
    except PebbleError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def open_link(place: Place, name: str, inbox: Inbox) -> Link:
    """Raises PebbleError if nobody is there."""
    if place.kind == "paho":
        return PahoLink(place.port)
    if place.kind == "mqtt":
        settings = MqttSettings(host="127.0.0.1", port=place.port, protocol=place.protocol)
        return TransportLink(create("mqtt", name, settings), inbox)
    run_dir = Path(place.run_dir)
    return TransportLink(create("zenoh", name, ZenohSettings(run_dir=run_dir, client=place.client)), inbox)


def _echo(link: Link, inbox: Inbox) -> None:
    Echo(link, WHO, time.monotonic_ns)
    ended = threading.Event()
    _listen(inbox, lambda _line: None, ended.set)
    _say(b'{"ready": true}')
    while not ended.is_set():
        job = inbox.take(None)
        if job is not None:
            job()
    link.close()


def _send(link: Link, inbox: Inbox) -> None:
    sender = Sender(link, WHO, time.monotonic_ns, inbox)

    def end() -> None:
        sender.ended = True

    _listen(inbox, lambda line: _say(msgspec.json.encode(_run(sender, line))), end)
    if not sender.warm_up(_WARM_UP, _WARM_UP_S):
        raise PebbleError("the echo does not answer")
    _say(b'{"ready": true}')
    while not sender.ended:
        job = inbox.take(None)
        if job is not None:
            job()
    link.close()


def _run(sender: Sender, line: str) -> Answer:
    sent, late, exchanges = sender.run(msgspec.json.decode(line, type=Order))
    return Answer(
        trips=sender.trips,
        sent=sent,
        late=late,
        one_way=[(exchange.t2 - exchange.t1) / 1000 for exchange in exchanges],
        round_trip=[(exchange.t4 - exchange.t1) / 1000 for exchange in exchanges],
        call=[ns / 1000 for ns in sender.calls_ns],
        fabric=[(exchange.came - exchange.t3) / 1000 for exchange in exchanges],
        inbox=[(exchange.t4 - exchange.came) / 1000 for exchange in exchanges],
    )


def _listen(inbox: Inbox, obey: Callable[[str], None], end: Callable[[], None]) -> None:
    """Standard input, on a thread of its own; what it asks for is done on the thread of the inbox."""

    def read() -> None:
        for line in sys.stdin:
            inbox.post_internal(lambda line=line: obey(line))  # type: ignore[misc]
        end()
        inbox.post_internal(lambda: None)

    threading.Thread(target=read, name="orders", daemon=True).start()


def _say(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
