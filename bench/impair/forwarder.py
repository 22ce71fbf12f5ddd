"""The process that holds an impaired network's two namespaces, and delays packets between them without netem.

Each namespace has a TUN device whose descriptor is held here: a packet sent into one device leaves the other one when
its schedule allows. When the process ends, the devices disappear, and so do the namespaces once they are empty.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import select
import signal
import stat
import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from pebble.bench.impair.conditions import Condition, Schedule, Shape
from pebble.rig import worker_end

WIRE, TIMED = "wire", "timed"  # the devices; packets of the second one pass through this process
ETHERNET = 14  # bytes of header that packets of a TUN device lack, but would have on a wire
_TUN = Path("/dev/net/tun")
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 65536  # bytes at most
_ROOM = 1000  # packets in flight per direction; 100 ms at 100 Mbit/s are 800
_AT_ONCE = 64  # packets read before others are written
_NICE = -10  # must not wait while the robot encodes pictures

_libc = ctypes.CDLL(None, use_errno=True)


class Direction:
    """Packets in flight from one device to the other, in order."""

    def __init__(self, source: int, sink: int, seed: str) -> None:
        self._source, self._sink, self._seed = source, sink, seed
        self._in_flight: deque[tuple[float, bytes]] = deque()
        self.lost = 0
        self.apply(Shape())

    def apply(self, shape: Shape) -> None:
        self._began, self._schedule = time.monotonic(), Schedule(shape, self._seed)

    @property
    def due(self) -> float | None:
        return self._in_flight[0][0] if self._in_flight else None

    def take(self) -> None:
        """Reads the packets available at the source."""
        for _ in range(_AT_ONCE):
            try:
                packet = os.read(self._source, _PACKET)
            except BlockingIOError:
                return
            self._send(packet)

    def deliver(self) -> None:
        """Writes the packets that are due."""
        now = time.monotonic()
        while self._in_flight and self._in_flight[0][0] <= now:
            try:
                os.write(self._sink, self._in_flight.popleft()[1])
            except OSError:  # the kernel's queue is full: the packet is lost
                self.lost += 1

    def _send(self, packet: bytes) -> None:
        arrival = self._schedule.arrival(time.monotonic() - self._began)
        if arrival is None or len(self._in_flight) >= _ROOM:
            self.lost += 1
            return
        last = self._in_flight[-1][0] if self._in_flight else 0.0
        self._in_flight.append((max(last, self._began + arrival), packet))


class NamespaceForwarder:
    """Two namespaces with a TUN device each, and the forwarding between them."""

    def __init__(self) -> None:
        self.robot, robot_tun = _namespace()
        self.remote, remote_tun = _namespace()
        self.up = Direction(robot_tun, remote_tun, "up")
        self.down = Direction(remote_tun, robot_tun, "down")
        self._sources = {robot_tun: self.up, remote_tun: self.down}

    def serve(self) -> None:
        """Forwards, and answers requests until standard input closes; each waits for the answer to the one before."""
        requests = sys.stdin.fileno()
        while True:
            ready, _, _ = select.select([requests, *self._sources], [], [], self._idle_s())
            for source in ready:
                if source != requests:
                    self._sources[source].take()
            self.up.deliver()
            self.down.deliver()
            if requests in ready:
                if not (line := sys.stdin.buffer.readline()):
                    return
                worker_end.answer(self._answer(line.strip()))

    def _answer(self, line: bytes) -> dict[str, Any]:
        if line == b"count":
            up, down = _transmitted(self.robot), _transmitted(self.remote)
            sent = {"bytes_up": up[0], "packets_up": up[1], "bytes_down": down[0], "packets_down": down[1]}
            return {**sent, "dropped_up": self.up.lost, "dropped_down": self.down.lost}
        condition = msgspec.json.decode(line, type=Condition)
        self.up.apply(condition.up)
        self.down.apply(condition.down)
        return {"applied": condition.name}

    def _idle_s(self) -> float | None:
        dues = [due for due in (self.up.due, self.down.due) if due is not None]
        return max(0.0, min(dues) - time.monotonic()) if dues else None


def _namespace() -> tuple[int, int]:
    """Enters a new network namespace with a TUN device in it; returns the descriptors of both."""
    _checked(_libc.unshare, _CLONE_NEWNET)
    space = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    tun = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)  # of the namespace it is opened in
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", TIMED.encode(), _IFF_TUN | _IFF_NO_PI))
    return space, tun


def _transmitted(space: int) -> tuple[int, int]:
    """Bytes and packets sent by both devices of a namespace, as on a wire."""
    _checked(_libc.setns, space, _CLONE_NEWNET)
    lines = (line.partition(":") for line in Path("/proc/thread-self/net/dev").read_text().splitlines())
    sent = {name.strip(): [int(column) for column in columns.split()[8:10]] for name, _, columns in lines if columns}
    (wire_bytes, wire_packets), (timed_bytes, timed_packets) = sent[WIRE], sent[TIMED]
    return wire_bytes + timed_bytes + timed_packets * ETHERNET, wire_packets + timed_packets


def _checked(call: Callable[..., int], *arguments: int) -> None:
    if call(*arguments) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _make_tun_node() -> None:
    """Creates /dev/net/tun, which containers often lack."""
    if not _TUN.exists():
        with suppress(PermissionError):
            _TUN.parent.mkdir(exist_ok=True)
            os.mknod(_TUN, stat.S_IFCHR | 0o600, os.makedev(10, 200))


def _refusal(error: OSError) -> dict[str, str]:
    """The answer if there are no namespaces: unavailable without permission or without TUN, else an error."""
    if isinstance(error, PermissionError):
        what = error.filename or "new namespaces"
        return {"unavailable": f"{what}: not permitted: run it as root, or in `unshare --map-root-user`"}
    if error.filename == str(_TUN):
        return {"unavailable": f"{_TUN}: {error.strerror}: the kernel has no TUN"}
    return {"error": f"new namespaces: {error.strerror}"}


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    _make_tun_node()
    try:
        forwarder = NamespaceForwarder()
    except OSError as error:
        worker_end.answer(_refusal(error))
        return 1
    worker_end.answer({"robot": forwarder.robot, "remote": forwarder.remote})
    forwarder.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
