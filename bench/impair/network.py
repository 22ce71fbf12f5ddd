"""Networks between a robot and its broker that can be impaired and restored while both use them.

Of two network namespaces: rate by TBF and loss by nftables, in the kernel; delay by the forwarder. Two pairs of devices
join the namespaces. Without delay, a veth pair carries everything, entirely in the kernel. With delay, the route uses
TUN devices and the forwarder. The addresses stay the same, so connections survive. Or a proxy on loopback.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

import msgspec

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.forwarder import ETHERNET, TIMED, WIRE
from pebble.errors import PebbleError
from pebble.rig.processes import python
from pebble.rig.programs import Worker, end_workers

KINDS = ("auto", "namespaces", "proxy")
ROBOT_HOST, REMOTE_HOST = "10.77.0.1", "10.77.0.2"
_PREFIX = 30
_MTU = 1500
_BURST = 1600  # bytes: one packet, so that the rate also holds over short times
_QUEUE_S = 0.3  # the queue of a home router's modem, with tail drop
_QUEUE_PACKETS = 4  # at least; at 64 kbit/s 0.3 s hold fewer than two
_COMMAND_S = 10.0
_SBIN = "/usr/local/sbin:/usr/sbin:/sbin"
_PACKAGES = {"nsenter": "util-linux", "ip": "iproute2", "tc": "iproute2", "nft": "nftables"}

_TABLE = """table ip impair {
    counter lost { }
    chain arriving { type filter hook prerouting priority raw; }
}
"""
_ANSWER_S = 10.0


@dataclass(frozen=True)
class Traffic:
    """Counters since the network was opened, with all headers, including dropped packets.

    Packets dropped by the rate limit were never on the wire; lost packets were.
    """

    bytes_up: int = 0
    bytes_down: int = 0
    packets_up: int = 0
    packets_down: int = 0
    dropped_up: int = 0
    dropped_down: int = 0


class UnavailableError(PebbleError):
    """This machine or user does not permit such a network."""


class ImpairedNetwork:
    """One robot's network, and the process that impairs it; thread-safe. ``name`` is for messages.

    Several may be open at the same time, independent. Raises UnavailableError if the process cannot make one.
    """

    kind: str  # "namespaces" or "proxy"
    broker_host: str  # the address on which the broker must listen

    def __init__(self, name: str = "") -> None:
        self._log = os.memfd_create("link")  # the log is an unnamed file: nothing is left behind if we are killed
        self._lock = threading.RLock()
        command, log = python("pebble.bench.impair.forwarder", self.kind), Path(f"/proc/self/fd/{self._log}")
        self._worker = Worker(f"network {name}".strip(), command, log)
        self._open = True
        try:
            answer = self._worker.answer(_ANSWER_S)
            if "unavailable" in answer:
                raise UnavailableError(str(answer["unavailable"]))
            if "error" in answer:
                raise PebbleError(str(answer["error"]))
            self.set_up(answer)
        except BaseException:
            self.close()
            raise

    def set_up(self, answer: dict[str, Any]) -> None:
        """What is left to do after the first answer of the process."""

    def broker_address(self, port: int) -> tuple[str, int]:
        """The robot's address for a broker that listens on ``broker_host:port``."""
        return self.broker_host, port

    def traffic(self) -> Traffic:
        return msgspec.convert(self.ask("count"), Traffic)

    def on_robot(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the robot's side. The process is replaced: pid and signals stay."""
        return list(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the broker's side."""
        return list(command)

    def apply(self, condition: Condition) -> None:
        """Applies a condition. Connections stay; the condition's time starts at 0."""
        self.ask(msgspec.json.encode(condition).decode())

    @property
    def pid(self) -> int:
        return self._worker.pid

    def ask(self, line: str) -> dict[str, Any]:
        """Sends a line and returns the answer. A timeout closes the process: its late answer would be misread."""
        with self._lock:
            if not self._open:
                raise PebbleError(f"{self._worker.name} is closed")
            try:
                return self._worker.ask(line, _ANSWER_S)
            except PebbleError:
                self.close()
                raise

    def close(self) -> None:
        """Ends it, which cuts all connections of the network; may be called repeatedly."""
        with self._lock:
            if self._open:
                self._open = False
                end_workers([self._worker])
                os.close(self._log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ProxyNetwork(ImpairedNetwork):
    """A TCP proxy on loopback, which models loss as delay; only connections through `broker_address` are impaired."""

    kind = "proxy"
    broker_host = "127.0.0.1"

    def broker_address(self, port: int) -> tuple[str, int]:
        return self.broker_host, int(self.ask(f"listen {port}")["port"])


class NamespaceNetwork(ImpairedNetwork):
    """Of two namespaces, which its process holds."""

    kind = "namespaces"
    broker_host = REMOTE_HOST

    def set_up(self, answer: dict[str, Any]) -> None:
        robot, remote = (f"/proc/{self.pid}/fd/{answer[side]}" for side in ("robot", "remote"))
        self._robot, self._remote = _Side(robot, ROBOT_HOST, REMOTE_HOST), _Side(remote, REMOTE_HOST, ROBOT_HOST)
        self._robot.batch("ip", f"link add {WIRE} type veth peer name {WIRE} netns {remote}")
        self._robot.set_up()
        self._remote.set_up()

    def on_robot(self, command: Sequence[str]) -> list[str]:
        return self._robot.inside(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        return self._remote.inside(command)

    def apply(self, condition: Condition) -> None:
        super().apply(condition)
        device = TIMED if condition.up.timed or condition.down.timed else WIRE
        self._robot.limit(condition.up.kbit)
        self._remote.limit(condition.down.kbit)
        self._remote.lose(condition.up.loss)
        self._robot.lose(condition.down.loss)
        self._robot.send_over(device)
        self._remote.send_over(device)

    def traffic(self) -> Traffic:
        """The process counts what was sent, and what it dropped itself."""
        count = super().traffic()
        up, down = self._robot.dropped() + self._remote.lost(), self._remote.dropped() + self._robot.lost()
        return replace(count, dropped_up=count.dropped_up + up, dropped_down=count.dropped_down + down)


class _Side:
    """One of the namespaces, configured with the system's tools."""

    def __init__(self, path: str, address: str, peer: str) -> None:
        self._path, self._address, self._peer = path, address, peer
        self._dropped_before = 0  # by queues that were replaced

    def inside(self, command: Sequence[str]) -> list[str]:
        return [_program("nsenter"), f"--net={self._path}", "--", *command]

    def set_up(self) -> None:
        self.batch("ip", "link set lo up", f"address add {self._address}/{_PREFIX} dev {WIRE}")
        for device in (WIRE, TIMED):
            self.batch(
                "ip",
                f"link set {device} mtu {_MTU} addrgenmode none",  # no IPv6 traffic of its own
                f"link set {device} gso_max_segs 1",  # otherwise packets of 64 KB are limited and dropped as one
                f"link set {device} up",
            )
        self.send_over(WIRE)
        self._run("nft", "-f", "-", stdin=_TABLE)

    def send_over(self, device: str) -> None:
        self.batch("ip", f"route replace {self._peer}/32 dev {device} src {self._address}")

    def limit(self, kbit: float | None) -> None:
        """Limits the rate of outgoing packets on both devices: only one of them is in use."""
        before = self.dropped()
        self.batch("tc", *(f"qdisc replace dev {device} root {_queue(kbit, device)}" for device in (WIRE, TIMED)))
        self._dropped_before += before - self.dropped()  # a new queue counts from 0

    def lose(self, share: float) -> None:
        """Drops a share of incoming packets."""
        rule = f'iifname != "lo" numgen random mod 10000 < {round(share * 10000)} counter name lost drop'
        add = f"add rule ip impair arriving {rule}\n" if share else ""
        self._run("nft", "-f", "-", stdin=f"flush chain ip impair arriving\n{add}")

    def dropped(self) -> int:
        """Packets dropped by the queues of this side."""
        queues = json.loads(self._run("tc", "-s", "-j", "qdisc", "show"))
        return self._dropped_before + sum(int(queue["drops"]) for queue in queues)

    def lost(self) -> int:
        listed = json.loads(self._run("nft", "-j", "list", "counter", "ip", "impair", "lost"))["nftables"]
        return sum(int(entry["counter"]["packets"]) for entry in listed if "counter" in entry)

    def batch(self, program: str, *lines: str) -> None:
        """Runs lines of ``ip`` or ``tc``."""
        self._run(program, "-batch", "-", stdin="".join(f"{line}\n" for line in lines))

    def _run(self, program: str, *arguments: str, stdin: str = "") -> str:
        command = self.inside([_program(program), *arguments])
        env = {**os.environ, "LC_ALL": "C"}  # its messages are read below
        try:
            done = subprocess.run(
                command, input=stdin, capture_output=True, text=True, timeout=_COMMAND_S, check=False, env=env
            )
        except subprocess.TimeoutExpired:
            raise PebbleError(f"{program} did not end within {_COMMAND_S:.0f} s") from None
        if done.returncode:
            answer = done.stderr.strip().splitlines() or [f"code {done.returncode}"]
            not_permitted = any(os.strerror(number) in answer[0] for number in (errno.EPERM, errno.EACCES))
            kind = UnavailableError if not_permitted else PebbleError
            raise kind(f"{program} {' '.join(arguments)}: {answer[0]}")
        return done.stdout


def _queue(kbit: float | None, device: str) -> str:
    """The queueing discipline in tc's syntax; without a limit the device's default."""
    if kbit is None:
        return "noqueue" if device == WIRE else "pfifo limit 1000"
    rate = kbit * 1000 / 8
    limit = max(rate * _QUEUE_S, _QUEUE_PACKETS * (_MTU + ETHERNET))
    return f"tbf rate {round(kbit * 1000)}bit burst {round(max(_BURST, rate * 0.005))} limit {round(limit)}"


def _program(name: str) -> str:
    """The path of a program; users' PATH lacks the folders in which Debian installs these."""
    found = shutil.which(name) or shutil.which(name, path=_SBIN)
    if found is None:
        raise UnavailableError(f"{name} is not installed: apt-get install {_PACKAGES[name]}")
    return found


def open_network(kind: str = "auto", *, name: str = "") -> ImpairedNetwork:
    """Opens a network of a kind as in `resolved`; ``name`` is for messages. Raises PebbleError if it is unavailable."""
    return (ProxyNetwork if resolved(kind)[0] == "proxy" else NamespaceNetwork)(name)


def resolved(kind: str) -> tuple[str, str | None]:
    """Resolves ``auto`` to namespaces if available, else to the proxy, with the reason.

    Raises PebbleError if the requested kind is unavailable.
    """
    if kind not in KINDS:
        raise PebbleError(f"no kind of network {kind!r}: choose from {', '.join(KINDS)}")
    obstacle = None if kind == "proxy" else why_no_namespaces()
    if kind == "namespaces" and obstacle:
        raise PebbleError(f"no network namespaces: {obstacle}; or choose the proxy")
    return "proxy" if kind == "proxy" or obstacle else "namespaces", obstacle


@cache
def why_no_namespaces() -> str | None:
    """What prevents networks of kind ``namespaces``; None: nothing. Tested with every feature a condition may use.

    Raises PebbleError if namespaces are permitted, but fail.
    """
    everything = Shape(kbit=1000, loss=0.01, delay_ms=1)
    try:
        with NamespaceNetwork("on trial") as network:
            network.apply(Condition("trial", everything, everything))
            network.traffic()
    except UnavailableError as error:
        return str(error)
    except PebbleError as error:
        raise PebbleError(f"network namespaces do not work here: {error}; or choose the proxy") from None
    return None
