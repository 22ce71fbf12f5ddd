"""The process of a proxy link: TCP connections through a shared rate, delays and gaps, and loss as TCP feels it.

A proxy cannot lose a segment of somebody else's connection. What loss does to one, it can do: everything behind a lost
segment waits until that one has been sent again. Fast retransmission needs three segments behind it, which the short
messages of a robot seldom are; so the wait is Linux's retransmission timeout, 200 ms at least and a round trip, and
twice as long if the repetition is lost as well. What loss does to TCP's congestion window is not modelled, nor are
acknowledgements and handshakes delayed.
"""

from __future__ import annotations

import asyncio
import json
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

from pebble.impair.conditions import Condition, Schedule, Shape

_HOST = "127.0.0.1"
_SEGMENT = 1448  # bytes of payload that go at once, so that connections take turns
_HEADERS = 66  # bytes: Ethernet, IP, and TCP with timestamps
_UNLIMITED = 65536  # bytes that go at once where there is no limit: nothing to take turns for
_BUFFER = 4096  # bytes that the sender's kernel may put into ours; it stands for the queue of the link
_UNDER_WAY = 64  # pieces per connection that may wait for their time
_SLACK_S = 0.005  # of the rate that is not lost because we woke up late
_RTO_MIN_S = 0.2  # Linux's TCP_RTO_MIN
_CONNECT_S = 5.0

_UnderWay = asyncio.Queue[tuple[float, bytes]]


class Direction:
    """What all connections share in one direction."""

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
        """Wait for a turn at the rate; returns when this piece arrives (monotonic)."""
        if self._shape.kbit is None:
            self._send(size)
        else:
            async with self._turn:
                await asyncio.sleep(self._send(size))
        return self._began + self._arrival(time.monotonic() - self._began, size)

    def _send(self, size: int) -> float:
        """It takes so many seconds, with those the line is already taken for."""
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
            self._send(size)  # the repetition takes its part of the line, too
            sent += wait
            wait *= 2
        return arrival


class Proxy:
    """Listeners for the ports that were asked for, and what passes through them."""

    def __init__(self) -> None:
        self._up, self._down = Direction("up"), Direction("down")
        self._tasks: set[asyncio.Task[None]] = set()

    def answer(self, line: str) -> dict[str, Any]:
        word, _, rest = line.partition(" ")
        if word == "listen":
            return {"port": self._listen(int(rest))}
        if word == "count":
            up, down = self._up, self._down
            return {
                "bytes_up": up.bytes,
                "bytes_down": down.bytes,
                "packets_up": up.packets,
                "packets_down": down.packets,
                "dropped_up": up.dropped,
                "dropped_down": down.dropped,
            }
        condition = msgspec.json.decode(line, type=Condition)
        round_trip_s = (condition.up.delay_ms + condition.down.delay_ms) / 1000
        self._up.apply(condition.up, round_trip_s)
        self._down.apply(condition.down, round_trip_s)
        return {"applied": condition.name}

    def _listen(self, target: int) -> int:
        listener = _socket()
        listener.bind((_HOST, 0))
        listener.listen(64)
        self._start(self._accept(listener, target))
        return int(listener.getsockname()[1])

    async def _accept(self, listener: socket.socket, target: int) -> None:
        while True:
            near, _ = await asyncio.get_running_loop().sock_accept(listener)
            self._start(self._join(near, target))

    async def _join(self, near: socket.socket, target: int) -> None:
        """One connection, until both of its directions have ended, or one end is gone: then the other one is, too."""
        with near, _socket() as far:
            near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                connecting = asyncio.get_running_loop().sock_connect(far, (_HOST, target))
                await asyncio.wait_for(connecting, _CONNECT_S)
                async with asyncio.TaskGroup() as group:
                    for source, sink, direction in ((near, far, self._up), (far, near, self._down)):
                        under_way: _UnderWay = asyncio.Queue(_UNDER_WAY)
                        group.create_task(_take(source, direction, under_way))
                        group.create_task(_deliver(under_way, sink))
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


async def _take(source: socket.socket, direction: Direction, under_way: _UnderWay) -> None:
    while data := await asyncio.get_running_loop().sock_recv(source, direction.piece):
        await under_way.put((await direction.carry(len(data)), data))
    await under_way.put((0.0, b""))


async def _deliver(under_way: _UnderWay, sink: socket.socket) -> None:
    """Everything at its time, in order; an end as an end."""
    while True:
        due, data = await under_way.get()
        if (wait := due - time.monotonic()) > 0:
            await asyncio.sleep(wait)
        if not data:
            sink.shutdown(socket.SHUT_WR)
            return
        await asyncio.get_running_loop().sock_sendall(sink, data)


async def _serve() -> None:
    """Answer until standard input ends; with this process end its connections."""
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(0, "rb"))
    proxy = Proxy()
    _say({"proxy": True})
    while line := await reader.readline():
        _say(proxy.answer(line.decode().strip()))


def _say(answer: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asyncio.run(_serve())
    return 0


if __name__ == "__main__":
    sys.exit(main())
