"""Networks between a robot and its broker that can be impaired and restored while both use them.

Two network namespaces, each with two devices: rate by TBF and loss by nftables, in the kernel. Without delay, a veth
pair carries everything, entirely in the kernel. With delay, the route uses TUN devices, whose descriptors are held by a
process: a packet sent into one device leaves the other one after the delay. The addresses stay the same, so
connections survive. When the process ends, the devices disappear, and so do the namespaces once they are empty.

``python -m pebble.bench.impair.network`` is that process. It applies each condition that it reads; after every line it
answers with the packets that it has dropped.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import math
import os
import select
import signal
import stat
import struct
import subprocess
import sys
import time
import weakref
from collections import deque
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from pebble.bench.impair.conditions import Condition, Shape
from pebble.errors import PebbleError
from pebble.rig.processes import SBIN, Worker, end_all, python
from pebble.rig.worker_end import answer

ROBOT_HOST, REMOTE_HOST = "10.77.0.1", "10.77.0.2"
_WIRE, _TIMED = "wire", "timed"  # the devices of a namespace; packets of the second one pass through the process
_MTU = 1500
_ETHERNET = 14  # bytes of header that packets of a TUN device lack, but would have on a wire
_BURST = 1600  # bytes: one packet, so that the rate also holds over short times
_QUEUE_S = 0.3  # the queue of a home router's modem, with tail drop
_QUEUE_PACKETS = 4  # at least; at 64 kbit/s 0.3 s hold fewer than two
_COMMAND_S = _ANSWER_S = 10.0

_TUN = Path("/dev/net/tun")
CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 65536  # bytes at most
_ROOM = 1000  # packets in flight per direction; 100 ms at 100 Mbit/s are 800
_AT_ONCE = 64  # packets read before others are written
_NICE = -10  # must not wait while the robot encodes pictures

_TABLE = "table ip impair { counter lost { }; chain arriving { type filter hook prerouting priority raw; }; }"


@dataclass(frozen=True)
class Traffic:
    """Counters, with all headers. Only differences within one condition mean something.

    Packets dropped by the rate limit were never on the wire; lost packets were.
    """

    bytes_up: int = 0
    dropped_up: int = 0


class NamespaceNetwork(Worker):
    """One robot's network: the process that holds its namespaces, whose end cuts all connections.

    ``on_robot`` and ``on_remote`` wrap a command so that it runs on the robot's or the broker's side. Several networks
    may be open at the same time, independent; ``name`` is for messages. Raises PebbleError.
    """

    def __init__(self, name: str = "") -> None:
        file = os.memfd_create("link")  # unnamed: nothing is left behind if we are killed
        weakref.finalize(self, os.close, file)
        command, log = python("pebble.bench.impair.network"), Path(f"/proc/self/fd/{file}")
        super().__init__(f"network {name}".strip(), command, log)
        try:
            spaces = self.answer(_ANSWER_S)
            if "unavailable" in spaces:
                raise PebbleError(spaces["unavailable"])
            robot, remote = (f"/proc/{self.pid}/fd/{spaces[side]}" for side in ("robot", "remote"))
            self._robot, self._remote = _Side(robot, ROBOT_HOST, REMOTE_HOST), _Side(remote, REMOTE_HOST, ROBOT_HOST)
            self.on_robot, self.on_remote = self._robot.inside, self._remote.inside
            self._robot.batch("ip", f"link add {_WIRE} type veth peer name {_WIRE} netns {remote}")
            self._robot.set_up()
            self._remote.set_up()
        except BaseException:
            self.close()
            raise

    def apply(self, condition: Condition) -> None:
        """Apply a condition. Connections stay."""
        self._request(msgspec.json.encode(condition).decode())
        device = _TIMED if condition.up.delay_ms or condition.down.delay_ms else _WIRE
        self._robot.apply(condition.up.kbit, condition.down.loss, device)
        self._remote.apply(condition.down.kbit, condition.up.loss, device)

    def traffic(self) -> Traffic:
        """The kernel counts, and the process what it dropped itself."""
        dropped = self._request("")["dropped_up"] + self._robot.dropped() + self._remote.lost()
        return Traffic(self._robot.sent_bytes(), dropped)

    def _request(self, line: str) -> dict[str, Any]:
        """Sends a line and returns the answer. A timeout ends the process: its late answer would be misread."""
        if self.ended:
            raise PebbleError(f"{self.name} is closed")
        try:
            return self.ask(line, _ANSWER_S)
        except PebbleError:
            self.close()
            raise

    def close(self) -> None:
        """May be called repeatedly."""
        end_all([self])


class _Side:
    """One of the namespaces, configured with the system's tools."""

    def __init__(self, path: str, address: str, peer: str) -> None:
        self._path, self._address, self._peer = path, address, peer

    def inside(self, command: Sequence[str]) -> list[str]:
        """The command on this side. The process is replaced: pid and signals stay."""
        return ["nsenter", f"--net={self._path}", "--", *command]

    def set_up(self) -> None:
        self.batch("ip", "link set lo up", f"address add {self._address}/30 dev {_WIRE}")
        for device in (_WIRE, _TIMED):
            self.batch(
                "ip",
                f"link set {device} mtu {_MTU} addrgenmode none",  # no IPv6 traffic of its own
                f"link set {device} gso_max_segs 1",  # otherwise packets of 64 KB are limited and dropped as one
                f"link set {device} up",
            )
        self._run("nft", "-f", "-", stdin=_TABLE)
        self.apply(None, 0.0, _WIRE)

    def apply(self, kbit: float | None, loss: float, device: str) -> None:
        """Limits the rate of outgoing packets, and drops a share of incoming ones, on both devices; one is in use."""
        self.batch("tc", *(f"qdisc replace dev {one} root {_queue(kbit, one)}" for one in (_WIRE, _TIMED)))
        rule = f'iifname != "lo" numgen random mod 10000 < {round(loss * 10000)} counter name lost drop'
        add = f"add rule ip impair arriving {rule}\n" if loss else ""
        self._run("nft", "-f", "-", stdin=f"flush chain ip impair arriving\n{add}")
        self.batch("ip", f"route replace {self._peer}/32 dev {device} src {self._address}")

    def sent_bytes(self) -> int:
        """Sent by both devices, as on a wire."""
        links = {one["ifname"]: one["stats64"]["tx"] for one in json.loads(self._run("ip", "-s", "-j", "link"))}
        return int(links[_WIRE]["bytes"] + links[_TIMED]["bytes"] + links[_TIMED]["packets"] * _ETHERNET)

    def dropped(self) -> int:
        """Packets dropped by the queues."""
        return sum(queue["drops"] for queue in json.loads(self._run("tc", "-s", "-j", "qdisc", "show")))

    def lost(self) -> int:
        listed = json.loads(self._run("nft", "-j", "list", "counter", "ip", "impair", "lost"))["nftables"]
        return sum(entry["counter"]["packets"] for entry in listed if "counter" in entry)

    def batch(self, program: str, *lines: str) -> None:
        """Runs lines of ``ip`` or ``tc``."""
        self._run(program, "-batch", "-", stdin="".join(f"{line}\n" for line in lines))

    def _run(self, program: str, *arguments: str, stdin: str = "") -> str:
        command, what = self.inside([program, *arguments]), f"{program} {' '.join(arguments)}"
        env = {**os.environ, "PATH": f"{os.environ.get('PATH', os.defpath)}:{SBIN}"}
        try:
            done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=_COMMAND_S, env=env)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise PebbleError(f"{what}: {error}") from None
        if done.returncode:
            raise PebbleError(f"{what}: {(done.stderr.strip() or f'code {done.returncode}').splitlines()[0]}")
        return done.stdout


def _queue(kbit: float | None, device: str) -> str:
    """The queueing discipline in tc's syntax; without a limit the device's default."""
    if kbit is None:
        return "noqueue" if device == _WIRE else "pfifo limit 1000"
    rate = kbit * 1000 / 8
    limit = max(rate * _QUEUE_S, _QUEUE_PACKETS * (_MTU + _ETHERNET))
    return f"tbf rate {round(kbit * 1000)}bit burst {round(max(_BURST, rate * 0.005))} limit {round(limit)}"


@cache
def why_no_namespaces() -> str | None:
    """What prevents such networks; None: nothing. Tested with every feature a condition may use."""
    everything = Shape(kbit=1000, loss=0.01, delay_ms=1)
    try:
        with closing(NamespaceNetwork("on trial")) as network:
            network.apply(Condition("trial", everything, everything))
            network.traffic()
    except PebbleError as error:
        return str(error)
    return None


def require_namespaces() -> None:
    """Raises PebbleError if there are none."""
    if why := why_no_namespaces():
        raise PebbleError(f"no network namespaces: {why}")


# -- its process


class Packets:
    """Packets in flight from one device to the other, in order."""

    def __init__(self, source: int, sink: int) -> None:
        self._source, self._sink, self._delay_s = source, sink, 0.0
        self._in_flight: deque[tuple[float, bytes]] = deque()
        self.dropped = 0

    def apply(self, shape: Shape) -> None:
        self._delay_s = shape.delay_ms / 1000

    @property
    def due(self) -> float:
        return self._in_flight[0][0] if self._in_flight else math.inf

    def take(self) -> None:
        """Reads the packets available at the source."""
        with suppress(BlockingIOError):
            for _ in range(_AT_ONCE):
                packet = os.read(self._source, _PACKET)
                if len(self._in_flight) >= _ROOM:
                    self.dropped += 1
                else:
                    last = self._in_flight[-1][0] if self._in_flight else 0.0
                    self._in_flight.append((max(last, time.monotonic() + self._delay_s), packet))

    def deliver(self) -> None:
        """Writes the packets that are due."""
        now = time.monotonic()
        while self.due <= now:
            try:
                os.write(self._sink, self._in_flight.popleft()[1])
            except OSError:  # the kernel's queue is full: the packet is lost
                self.dropped += 1


def main() -> int:
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
        if not _TUN.exists():  # containers often lack it
            _TUN.parent.mkdir(exist_ok=True)
            os.mknod(_TUN, stat.S_IFCHR | 0o600, os.makedev(10, 200))
    try:
        (robot, robot_tun), (remote, remote_tun) = _namespace(), _namespace()
    except OSError as error:
        why = f"{error.filename or 'new namespaces'}: {error.strerror}"
        answer({"unavailable": f"{why}: run it as root, or in `unshare --map-root-user`"})
        return 1
    answer({"robot": robot, "remote": remote})
    up, down = Packets(robot_tun, remote_tun), Packets(remote_tun, robot_tun)
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
            if line.strip():
                condition = msgspec.json.decode(line, type=Condition)
                up.apply(condition.up)
                down.apply(condition.down)
            answer({"dropped_up": up.dropped})


def _namespace() -> tuple[int, int]:
    """Enters a new network namespace with a TUN device in it; returns the descriptors of both. Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    tun = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)  # of the namespace it is opened in
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", _TIMED.encode(), _IFF_TUN | _IFF_NO_PI))
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY), tun


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(main())
