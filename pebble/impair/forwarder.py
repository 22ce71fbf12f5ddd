"""The process that holds a link's two network namespaces, and delays packets between them without the kernel's netem.

Each namespace has a TUN device whose descriptor is held here: what is sent into one device comes out of the other when
its schedule says so. With the process go the devices, and, when nobody is left in them, the namespaces.
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
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from pebble.errors import PebbleError
from pebble.impair.conditions import Condition, Schedule, Shape
from pebble.impair.helper import UnavailableError

TIMED = "timed"  # the device whose packets pass through here
_TUN = Path("/dev/net/tun")
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 65536  # bytes at most
_ROOM = 1000  # packets that may wait in one direction; 100 ms at 100 Mbit/s are 800
_AT_ONCE = 64  # packets that are read before others are written
_NICE = -10  # the link must not wait for the robot's pictures to be encoded

_libc = ctypes.CDLL(None, use_errno=True)


class Direction:
    """Packets under way from one device to the other, in order."""

    def __init__(self, source: int, sink: int, seed: str) -> None:
        self._source, self._sink, self._seed = source, sink, seed
        self._under_way: deque[tuple[float, bytes]] = deque()
        self.lost = 0
        self.apply(Shape())

    def apply(self, shape: Shape) -> None:
        self._began, self._schedule = time.monotonic(), Schedule(shape, self._seed)

    @property
    def due(self) -> float | None:
        return self._under_way[0][0] if self._under_way else None

    def take(self) -> None:
        """Read what has come to the source, as far as there is some."""
        for _ in range(_AT_ONCE):
            try:
                packet = os.read(self._source, _PACKET)
            except BlockingIOError:
                return
            self._send(packet)

    def deliver(self) -> None:
        """Write what is due."""
        now = time.monotonic()
        while self._under_way and self._under_way[0][0] <= now:
            try:
                os.write(self._sink, self._under_way.popleft()[1])
            except OSError:  # its kernel has no room: on this line, too, it is lost
                self.lost += 1

    def _send(self, packet: bytes) -> None:
        arrival = self._schedule.arrival(time.monotonic() - self._began)
        if arrival is None or len(self._under_way) >= _ROOM:
            self.lost += 1
            return
        last = self._under_way[-1][0] if self._under_way else 0.0
        self._under_way.append((max(last, self._began + arrival), packet))


class Holder:
    """Two namespaces with a TUN device each, and what is asked of them."""

    def __init__(self) -> None:
        self.robot, robot_tun = _namespace()
        self.remote, remote_tun = _namespace()
        self.up = Direction(robot_tun, remote_tun, "up")
        self.down = Direction(remote_tun, robot_tun, "down")
        self._sources = {robot_tun: self.up, remote_tun: self.down}

    def serve(self, orders: int) -> None:
        """Forward until ``orders`` is at its end."""
        asked = b""
        while True:
            ready, _, _ = select.select([orders, *self._sources], [], [], self._idle_s())
            for source in ready:
                if source != orders:
                    self._sources[source].take()
            self.up.deliver()
            self.down.deliver()
            if orders in ready:
                said = os.read(orders, 4096)
                if not said:
                    return
                *lines, asked = (asked + said).split(b"\n")
                for line in lines:
                    _say(self._answer(line))

    def _answer(self, line: bytes) -> dict[str, Any]:
        if line == b"count":
            counts = {side: _transmitted(space) for side, space in (("up", self.robot), ("down", self.remote))}
            return {**counts, "lost_up": self.up.lost, "lost_down": self.down.lost}
        condition = msgspec.json.decode(line, type=Condition)
        self.up.apply(condition.up)
        self.down.apply(condition.down)
        return {"applied": condition.name}

    def _idle_s(self) -> float | None:
        dues = [due for due in (self.up.due, self.down.due) if due is not None]
        return max(0.0, min(dues) - time.monotonic()) if dues else None


def _namespace() -> tuple[int, int]:
    """A new network namespace, which this process is then in, and the TUN device in it: two descriptors."""
    _checked(_libc.unshare, _CLONE_NEWNET)
    space = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    tun = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)  # of the namespace it is opened in
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", TIMED.encode(), _IFF_TUN | _IFF_NO_PI))
    return space, tun


def _transmitted(space: int) -> dict[str, tuple[int, int]]:
    """Bytes and packets that each device of a namespace has sent."""
    _checked(_libc.setns, space, _CLONE_NEWNET)
    return dict(_devices(Path("/proc/thread-self/net/dev").read_text()))


def _devices(text: str) -> Iterator[tuple[str, tuple[int, int]]]:
    for line in text.splitlines()[2:]:
        name, _, figures = line.partition(":")
        columns = figures.split()
        yield name.strip(), (int(columns[8]), int(columns[9]))


def _checked(call: Callable[..., int], *arguments: int) -> None:
    if call(*arguments) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _make_tun_node() -> None:
    """Containers often lack it."""
    if not _TUN.exists():
        with suppress(PermissionError):
            _TUN.parent.mkdir(exist_ok=True)
            os.mknod(_TUN, stat.S_IFCHR | 0o600, os.makedev(10, 200))


def _hold() -> Holder:
    """Raises UnavailableError where namespaces are not permitted or there is no TUN, PebbleError for other trouble."""
    _make_tun_node()
    try:
        return Holder()
    except PermissionError as error:
        what = error.filename or "new namespaces"
        raise UnavailableError(f"{what}: not permitted: run it as root, or in `unshare --map-root-user`") from None
    except OSError as error:
        if error.filename == str(_TUN):
            raise UnavailableError(f"{_TUN}: {error.strerror}: the kernel has no TUN") from None
        raise PebbleError(f"new namespaces: {error.strerror}") from None


def _say(answer: dict[str, Any]) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
    sys.stdout.buffer.flush()


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    try:
        holder = _hold()
    except PebbleError as error:
        _say({"unavailable" if isinstance(error, UnavailableError) else "error": str(error)})
        return 1
    _say({"robot": holder.robot, "remote": holder.remote})
    holder.serve(sys.stdin.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
