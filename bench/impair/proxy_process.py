"""The process of a proxy network: TCP connections through a shared rate, delays and gaps, and loss as TCP shows it.

A proxy cannot drop a segment of a connection. It can imitate the effect: everything behind a lost segment waits until
that one has been retransmitted. Fast retransmission needs three segments behind it, which a robot's short messages
rarely have; so the wait is Linux's retransmission timeout, at least 200 ms and a round trip, and doubles if the
retransmission is lost as well. The effect of loss on TCP's congestion window is not modelled, nor are
acknowledgements and handshakes delayed.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Coroutine
from random import Random
from typing import Any

import msgspec

from pebble.bench.impair.conditions import Condition, Schedule, Shape
from pebble.rig import worker_end

_HOST = "127.0.0.1"
_SEGMENT = 1448  # bytes of payload sent at once, so that connections take turns
_HEADERS = 66  # bytes: Ethernet, IP, and TCP with timestamps
_UNLIMITED = 65536  # bytes sent at once without a limit
_BUFFER = 4096  # bytes of receive buffer; it represents the network's queue
_IN_FLIGHT_LIMIT = 64  # pieces per connection
_SLACK_S = 0.005  # of the rate that a late wake-up does not lose
_RTO_MIN_S = 0.2  # Linux's TCP_RTO_MIN
_CONNECT_S = 5.0

_InFlight = asyncio.Queue[tuple[float, bytes]]


class Direction:
    """The rate, delay and loss that all connections share in one direction."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        self._turn = asyncio.Lock()
        self.bytes = self.packets = self.dropped = 0
        self.apply(Shape(), 0.0)

    def apply(self, shape: Shape, round_trip_s: float) -> None:
        self._shape, self._rto_s = shape, _RTO_MIN_S + round_trip_s
        self._began, self._schedule = time.monotonic(), Schedule(shape, self._seed)
        self._free_at = 0.0
        self._chance = Random(self._seed)  # noqa: S311

    @property
    def piece(self) -> int:
        return _UNLIMITED if self._shape == Shape() else _SEGMENT

    async def carry(self, size: int) -> float:
        """Waits for its share of the rate; returns when this piece arrives (monotonic)."""
        if self._shape.kbit is None:
            self._send(size)
        else:
            async with self._turn:
                await asyncio.sleep(self._send(size))
        return self._began + self._arrival(time.monotonic() - self._began, size)

    def _send(self, size: int) -> float:
        """Seconds until the piece is sent, including the pieces before it."""
        packets = math.ceil(size / _SEGMENT)
        on_the_wire = size + packets * _HEADERS
        self.bytes += on_the_wire
        self.packets += packets
        if self._shape.kbit is None:
            return 0.0
        now = time.monotonic()
        self._free_at = max(self._free_at, now - _SLACK_S) + on_the_wire * 8 / (self._shape.kbit * 1000)
        return self._free_at - now

    def _arrival(self, sent: float, size: int) -> float:
        wait = self._rto_s
        while (arrival := self._schedule.arrival(sent)) is None or self._chance.random() < self._shape.loss:
            self.dropped += 1
            self._send(size)  # the retransmission uses the rate, too
            sent += wait
            wait *= 2
        return arrival


class Proxy:
    """Listeners for the requested ports, and their connections."""

    def __init__(self) -> None:
        self._up, self._down = Direction("up"), Direction("down")
        self._ports: dict[int, int] = {}  # ours, by that of the broker
        self._tasks: set[asyncio.Task[None]] = set()

    def answer(self, line: str) -> dict[str, Any]:
        word, _, rest = line.partition(" ")
        if word == "listen":
            return {"port": self._listen(int(rest))}
        if word == "count":
            both, counted = (("up", self._up), ("down", self._down)), ("bytes", "packets", "dropped")
            return {f"{name}_{way}": getattr(direction, name) for way, direction in both for name in counted}
        condition = msgspec.json.decode(line, type=Condition)
        round_trip_s = (condition.up.delay_ms + condition.down.delay_ms) / 1000
        self._up.apply(condition.up, round_trip_s)
        self._down.apply(condition.down, round_trip_s)
        return {"applied": condition.name}

    def _listen(self, target: int) -> int:
        if target not in self._ports:
            listener = _socket()
            listener.bind((_HOST, 0))
            listener.listen(64)
            self._start(self._accept(listener, target))
            self._ports[target] = listener.getsockname()[1]
        return self._ports[target]

    async def _accept(self, listener: socket.socket, target: int) -> None:
        while True:
            near, _ = await asyncio.get_running_loop().sock_accept(listener)
            self._start(self._join(near, target))

    async def _join(self, near: socket.socket, target: int) -> None:
        """Forwards one connection until both directions have ended, or one side fails: then the other closes, too."""
        with near, _socket() as far:
            near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                connecting = asyncio.get_running_loop().sock_connect(far, (_HOST, target))
                await asyncio.wait_for(connecting, _CONNECT_S)
                async with asyncio.TaskGroup() as group:
                    for source, sink, direction in ((near, far, self._up), (far, near, self._down)):
                        in_flight: _InFlight = asyncio.Queue(_IN_FLIGHT_LIMIT)
                        group.create_task(_take(source, direction, in_flight))
                        group.create_task(_deliver(in_flight, sink))
            except* OSError:
                pass

    def _start(self, what: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(what)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _socket() -> socket.socket:
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, _SEGMENT)  # the loopback device has segments of 64 KB
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    made.setblocking(False)
    return made


async def _take(source: socket.socket, direction: Direction, in_flight: _InFlight) -> None:
    while data := await asyncio.get_running_loop().sock_recv(source, direction.piece):
        await in_flight.put((await direction.carry(len(data)), data))
    await in_flight.put((0.0, b""))


async def _deliver(in_flight: _InFlight, sink: socket.socket) -> None:
    """Writes each piece at its time, in order; forwards the end of the stream."""
    while True:
        due, data = await in_flight.get()
        if (wait := due - time.monotonic()) > 0:
            await asyncio.sleep(wait)
        if not data:
            sink.shutdown(socket.SHUT_WR)
            return
        await asyncio.get_running_loop().sock_sendall(sink, data)


async def _serve() -> None:
    """Answers requests until standard input closes; connections end with the process."""
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(0, "rb"))
    proxy = Proxy()
    worker_end.answer({"proxy": True})
    while line := await reader.readline():
        worker_end.answer(proxy.answer(line.decode().strip()))


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asyncio.run(_serve())
    return 0


if __name__ == "__main__":
    sys.exit(main())
