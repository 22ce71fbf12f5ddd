"""The process of an impaired network: it forwards what the two sides send, and delays it without netem.

``namespaces``: it holds two network namespaces, each with a TUN device whose descriptor is held here: a packet sent
into one device leaves the other one when its schedule allows. When the process ends, the devices disappear, and so do
the namespaces once they are empty.

``proxy``: TCP connections through a shared rate, delays and gaps, and loss as TCP shows it. A proxy cannot drop a
segment of a connection. It can imitate the effect: everything behind a lost segment waits until that one has been
retransmitted. Fast retransmission needs three segments behind it, which a robot's short messages rarely have; so the
wait is Linux's retransmission timeout, at least 200 ms and a round trip, and doubles if the retransmission is lost as
well. The effect of loss on TCP's congestion window is not modelled, nor are acknowledgements and handshakes delayed.
"""

from __future__ import annotations

import asyncio
import ctypes
import fcntl
import math
import os
import select
import signal
import socket
import stat
import struct
import sys
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import msgspec

from pebble.bench.impair.conditions import Condition, Schedule, Shape
from pebble.rig import worker_end

TIMED = "timed"  # the TUN device of a namespace
_TUN = Path("/dev/net/tun")
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 65536  # bytes at most
_ROOM = 1000  # packets in flight per direction; 100 ms at 100 Mbit/s are 800
_AT_ONCE = 64  # packets read before others are written
_NICE = -10  # must not wait while the robot encodes pictures

_HOST = "127.0.0.1"  # of the proxy
SEGMENT = 1448  # bytes of payload sent at once, so that connections take turns
HEADERS = 66  # bytes: Ethernet, IP, and TCP with timestamps
_UNLIMITED = 65536  # bytes sent at once without a limit
_BUFFER = 4096  # bytes of receive buffer; it represents the network's queue
_IN_FLIGHT_LIMIT = 64  # pieces per connection
_SLACK_S = 0.005  # of the rate that a late wake-up does not lose
_RTO_MIN_S = 0.2  # Linux's TCP_RTO_MIN
_CONNECT_S = 5.0


class Direction:
    """One direction: what was sent, and what was dropped."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        self.bytes = self.packets = self.dropped = 0
        self.apply(Shape(), 0.0)

    def apply(self, shape: Shape, round_trip_s: float) -> None:
        self._shape, self._round_trip_s = shape, round_trip_s
        self._began, self._schedule = time.monotonic(), Schedule(shape, self._seed)


def answer(line: str, up: Direction, down: Direction) -> dict[str, Any]:
    """Of both kinds of network: what was counted so far of the uplink, or a condition is applied from now on."""
    if line == "count":
        return {"bytes_up": up.bytes, "packets_up": up.packets, "dropped_up": up.dropped}
    condition = msgspec.json.decode(line, type=Condition)
    round_trip_s = (condition.up.delay_ms + condition.down.delay_ms) / 1000
    up.apply(condition.up, round_trip_s)
    down.apply(condition.down, round_trip_s)
    return {"applied": condition.name}


# -- packets between two namespaces


class Packets(Direction):
    """Packets in flight from one device to the other, in order."""

    def __init__(self, source: int, sink: int, seed: str) -> None:
        super().__init__(seed)
        self._source, self._sink = source, sink
        self._in_flight: deque[tuple[float, bytes]] = deque()

    @property
    def due(self) -> float:
        return self._in_flight[0][0] if self._in_flight else math.inf

    def take(self) -> None:
        """Reads the packets available at the source."""
        with suppress(BlockingIOError):
            for _ in range(_AT_ONCE):
                self._send(os.read(self._source, _PACKET))

    def deliver(self) -> None:
        """Writes the packets that are due."""
        now = time.monotonic()
        while self.due <= now:
            try:
                os.write(self._sink, self._in_flight.popleft()[1])
            except OSError:  # the kernel's queue is full: the packet is lost
                self.dropped += 1

    def _send(self, packet: bytes) -> None:
        arrival = self._schedule.arrival(time.monotonic() - self._began)
        if arrival is None or len(self._in_flight) >= _ROOM:
            self.dropped += 1
            return
        last = self._in_flight[-1][0] if self._in_flight else 0.0
        self._in_flight.append((max(last, self._began + arrival), packet))


def namespaces() -> int:
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
        if not _TUN.exists():  # containers often lack it
            _TUN.parent.mkdir(exist_ok=True)
            os.mknod(_TUN, stat.S_IFCHR | 0o600, os.makedev(10, 200))
    try:
        (robot, robot_tun), (remote, remote_tun) = _namespace(), _namespace()
    except OSError as error:
        why = f"{error.filename or 'new namespaces'}: {error.strerror}"
        worker_end.answer({"unavailable": f"{why}: run it as root, or in `unshare --map-root-user`"})
        return 1
    worker_end.answer({"robot": robot, "remote": remote})
    up, down = Packets(robot_tun, remote_tun, "up"), Packets(remote_tun, robot_tun, "down")
    sources, requests = {robot_tun: up, remote_tun: down}, sys.stdin.fileno()
    while True:
        due = min(up.due, down.due)
        idle_s = None if due == math.inf else max(0.0, due - time.monotonic())
        ready, _, _ = select.select([requests, *sources], [], [], idle_s)
        for source in sources.keys() & ready:
            sources[source].take()
        up.deliver()
        down.deliver()
        if requests in ready:  # each waits for the answer to the one before
            if not (line := sys.stdin.buffer.readline()):
                return 0
            worker_end.answer(answer(line.decode().strip(), up, down))


def _namespace() -> tuple[int, int]:
    """Enters a new network namespace with a TUN device in it; returns the descriptors of both. Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    tun = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)  # of the namespace it is opened in
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", TIMED.encode(), _IFF_TUN | _IFF_NO_PI))
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY), tun


# -- TCP connections through a proxy


class Stream(Direction):
    """The rate, delay and loss that all connections share in one direction."""

    def __init__(self, seed: str) -> None:
        super().__init__(seed)
        self._turn = asyncio.Lock()

    def apply(self, shape: Shape, round_trip_s: float) -> None:
        super().apply(shape, round_trip_s)
        self._free_at = 0.0
        self._chance = Random(self._seed)  # noqa: S311

    @property
    def piece(self) -> int:
        return _UNLIMITED if self._shape == Shape() else SEGMENT

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
        packets = math.ceil(size / SEGMENT)
        on_the_wire = size + packets * HEADERS
        self.bytes += on_the_wire
        self.packets += packets
        if self._shape.kbit is None:
            return 0.0
        now = time.monotonic()
        self._free_at = max(self._free_at, now - _SLACK_S) + on_the_wire * 8 / (self._shape.kbit * 1000)
        return self._free_at - now

    def _arrival(self, sent: float, size: int) -> float:
        wait = _RTO_MIN_S + self._round_trip_s
        while (arrival := self._schedule.arrival(sent)) is None or self._chance.random() < self._shape.loss:
            self.dropped += 1
            self._send(size)  # the retransmission uses the rate, too
            sent += wait
            wait *= 2
        return arrival


_InFlight = asyncio.Queue[tuple[float, bytes]]


class Proxy:
    """Listeners for the requested ports, and their connections, which end with the process."""

    def __init__(self) -> None:
        self._up, self._down = Stream("up"), Stream("down")
        self._tasks: list[asyncio.Task[None]] = []

    async def serve(self) -> None:
        """Answers requests until standard input closes."""
        reader, loop = asyncio.StreamReader(), asyncio.get_running_loop()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(0, "rb"))
        worker_end.answer({"proxy": True})
        while line := (await reader.readline()).decode().strip():
            word, _, port = line.partition(" ")
            listens = word == "listen"
            worker_end.answer({"port": self._listen(int(port))} if listens else answer(line, self._up, self._down))

    def _listen(self, target: int) -> int:
        listener = _socket()
        listener.bind((_HOST, 0))
        listener.listen(64)
        self._tasks.append(asyncio.create_task(self._accept(listener, target)))
        return int(listener.getsockname()[1])

    async def _accept(self, listener: socket.socket, target: int) -> None:
        while True:
            near, _ = await asyncio.get_running_loop().sock_accept(listener)
            self._tasks.append(asyncio.create_task(self._join(near, target)))

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


def _socket() -> socket.socket:
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT)  # the loopback device has segments of 64 KB
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    made.setblocking(False)
    return made


async def _take(source: socket.socket, direction: Stream, in_flight: _InFlight) -> None:
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


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(namespaces() if sys.argv[1] == "namespaces" else asyncio.run(Proxy().serve()))
