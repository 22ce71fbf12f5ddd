"""Networks between a robot and its broker that can be impaired and restored while both use them.

Of two network namespaces: rate by TBF and loss by nftables, in the kernel; delay by the forwarder. Two pairs of devices
join the namespaces. Without delay, a veth pair carries everything, entirely in the kernel. With delay, the route uses
TUN devices and the forwarder. The addresses stay the same, so connections survive. Or a proxy on loopback.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import msgspec

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.forwarder import TIMED
from pebble.errors import PebbleError
from pebble.rig.processes import python
from pebble.rig.programs import Worker, end_workers

ROBOT_HOST, REMOTE_HOST = "10.77.0.1", "10.77.0.2"
_WIRE = "wire"  # the veth device of a namespace
_PREFIX = 30
_MTU = 1500
_ETHERNET = 14  # bytes of header that packets of a TUN device lack, but would have on a wire
_BURST = 1600  # bytes: one packet, so that the rate also holds over short times
_QUEUE_S = 0.3  # the queue of a home router's modem, with tail drop
_QUEUE_PACKETS = 4  # at least; at 64 kbit/s 0.3 s hold fewer than two
_COMMAND_S = _ANSWER_S = 10.0
_SBIN = "/usr/local/sbin:/usr/sbin:/sbin"  # not in the PATH of users
_PACKAGES = {"nsenter": "util-linux", "ip": "iproute2", "tc": "iproute2", "nft": "nftables"}

_TABLE = """table ip impair {
    counter lost { }
    chain arriving { type filter hook prerouting priority raw; }
}
"""


@dataclass(frozen=True)
class Traffic:
    """Counters of the uplink, with all headers. Only differences within one condition mean something.

    Packets dropped by the rate limit were never on the wire; lost packets were.
    """

    bytes_up: int = 0
    packets_up: int = 0
    dropped_up: int = 0


class UnavailableError(PebbleError):
    """This machine or user does not permit such a network."""


class ImpairedNetwork(Worker):
    """One robot's network: the process that impairs it, whose end cuts all connections. ``name`` is for messages.

    Several may be open at the same time, independent. Raises UnavailableError if the process cannot make one.
    """

    kind: str  # "namespaces" or "proxy"
    broker_host: str  # the address on which the broker must listen

    def __init__(self, name: str = "") -> None:
        self._file = os.fdopen(os.memfd_create("link"))  # unnamed: nothing is left behind if we are killed
        command, log = python("pebble.bench.impair.forwarder", self.kind), Path(f"/proc/self/fd/{self._file.fileno()}")
        super().__init__(f"network {name}".strip(), command, log)
        try:
            self.set_up(self.answer(_ANSWER_S))
        except BaseException:
            self.close()
            raise

    def set_up(self, answer: dict[str, Any]) -> None:
        """What is left to do after the first answer of the process."""

    def broker_address(self, port: int) -> tuple[str, int]:
        """The robot's address for a broker that listens on ``broker_host:port``."""
        return self.broker_host, port

    def on_robot(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the robot's side. The process is replaced: pid and signals stay."""
        return list(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the broker's side."""
        return list(command)

    def apply(self, condition: Condition) -> None:
        """Applies a condition. Connections stay; the condition's time starts at 0."""
        self.request(msgspec.json.encode(condition).decode())

    def traffic(self) -> Traffic:
        return msgspec.convert(self.request("count"), Traffic)

    def request(self, line: str) -> dict[str, Any]:
        """Sends a line and returns the answer. A timeout ends the process: its late answer would be misread."""
        if self.ended:
            raise PebbleError(f"{self.name} is closed")
        try:
            return self.ask(line, _ANSWER_S)
        except PebbleError:
            self.close()
            raise

    def end(self, deadline: float) -> None:
        super().end(deadline)
        self._file.close()

    def close(self) -> None:
        """May be called repeatedly."""
        end_workers([self])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ProxyNetwork(ImpairedNetwork):
    """A TCP proxy on loopback, which models loss as delay; only connections through `broker_address` are impaired."""

    kind = "proxy"
    broker_host = "127.0.0.1"

    def broker_address(self, port: int) -> tuple[str, int]:
        return self.broker_host, int(self.request(f"listen {port}")["port"])


class NamespaceNetwork(ImpairedNetwork):
    """Of two namespaces, which its process holds."""

    kind = "namespaces"
    broker_host = REMOTE_HOST

    def set_up(self, answer: dict[str, Any]) -> None:
        if "unavailable" in answer:
            raise UnavailableError(answer["unavailable"])
        robot, remote = (f"/proc/{self.pid}/fd/{answer[side]}" for side in ("robot", "remote"))
        self._robot, self._remote = _Side(robot, ROBOT_HOST, REMOTE_HOST), _Side(remote, REMOTE_HOST, ROBOT_HOST)
        self._robot.batch("ip", f"link add {_WIRE} type veth peer name {_WIRE} netns {remote}")
        self._robot.set_up()
        self._remote.set_up()

    def on_robot(self, command: Sequence[str]) -> list[str]:
        return self._robot.inside(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        return self._remote.inside(command)

    def apply(self, condition: Condition) -> None:
        super().apply(condition)
        device = TIMED if condition.up.timed or condition.down.timed else _WIRE
        self._robot.apply(condition.up.kbit, condition.down.loss, device)
        self._remote.apply(condition.down.kbit, condition.up.loss, device)

    def traffic(self) -> Traffic:
        """The kernel counts, and the process what it dropped itself."""
        sent_bytes, sent_packets, dropped = self._robot.sent()
        return Traffic(sent_bytes, sent_packets, dropped + self._remote.lost() + super().traffic().dropped_up)


class _Side:
    """One of the namespaces, configured with the system's tools."""

    def __init__(self, path: str, address: str, peer: str) -> None:
        self._path, self._address, self._peer = path, address, peer

    def inside(self, command: Sequence[str]) -> list[str]:
        return [_program("nsenter"), f"--net={self._path}", "--", *command]

    def set_up(self) -> None:
        self.batch("ip", "link set lo up", f"address add {self._address}/{_PREFIX} dev {_WIRE}")
        for device in (_WIRE, TIMED):
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
        self.batch("tc", *(f"qdisc replace dev {one} root {_queue(kbit, one)}" for one in (_WIRE, TIMED)))
        rule = f'iifname != "lo" numgen random mod 10000 < {round(loss * 10000)} counter name lost drop'
        add = f"add rule ip impair arriving {rule}\n" if loss else ""
        self._run("nft", "-f", "-", stdin=f"flush chain ip impair arriving\n{add}")
        self.batch("ip", f"route replace {self._peer}/32 dev {device} src {self._address}")

    def sent(self) -> tuple[int, int, int]:
        """Bytes and packets sent by both devices, as on a wire, and the packets dropped by their queues."""
        links = {one["ifname"]: one["stats64"]["tx"] for one in json.loads(self._run("ip", "-s", "-j", "link"))}
        wire, timed = links[_WIRE], links[TIMED]
        sent_bytes = wire["bytes"] + timed["bytes"] + timed["packets"] * _ETHERNET
        queues = json.loads(self._run("tc", "-s", "-j", "qdisc", "show"))
        return sent_bytes, wire["packets"] + timed["packets"], sum(queue["drops"] for queue in queues)

    def lost(self) -> int:
        listed = json.loads(self._run("nft", "-j", "list", "counter", "ip", "impair", "lost"))["nftables"]
        return sum(entry["counter"]["packets"] for entry in listed if "counter" in entry)

    def batch(self, program: str, *lines: str) -> None:
        """Runs lines of ``ip`` or ``tc``."""
        self._run(program, "-batch", "-", stdin="".join(f"{line}\n" for line in lines))

    def _run(self, program: str, *arguments: str, stdin: str = "") -> str:
        command, what = self.inside([_program(program), *arguments]), f"{program} {' '.join(arguments)}"
        env = {**os.environ, "LC_ALL": "C"}  # its messages are read below
        try:
            done = subprocess.run(
                command, input=stdin, capture_output=True, text=True, timeout=_COMMAND_S, check=True, env=env
            )
        except subprocess.TimeoutExpired:
            raise PebbleError(f"{what} did not end within {_COMMAND_S:.0f} s") from None
        except subprocess.CalledProcessError as error:
            why = error.stderr.strip().partition("\n")[0] or f"code {error.returncode}"
            refused = "not permitted" in why or "Permission denied" in why
            raise (UnavailableError if refused else PebbleError)(f"{what}: {why}") from None
        return done.stdout


def _queue(kbit: float | None, device: str) -> str:
    """The queueing discipline in tc's syntax; without a limit the device's default."""
    if kbit is None:
        return "noqueue" if device == _WIRE else "pfifo limit 1000"
    rate = kbit * 1000 / 8
    limit = max(rate * _QUEUE_S, _QUEUE_PACKETS * (_MTU + _ETHERNET))
    return f"tbf rate {round(kbit * 1000)}bit burst {round(max(_BURST, rate * 0.005))} limit {round(limit)}"


def _program(name: str) -> str:
    found = shutil.which(name, path=f"{os.environ.get('PATH', '')}:{_SBIN}")
    if found is None:
        raise UnavailableError(f"{name} is not installed: apt-get install {_PACKAGES[name]}")
    return found


def open_network(kind: str, name: str = "") -> ImpairedNetwork:
    """Raises PebbleError if this kind is unavailable."""
    return NamespaceNetwork(name) if kind == "namespaces" else ProxyNetwork(name)


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
