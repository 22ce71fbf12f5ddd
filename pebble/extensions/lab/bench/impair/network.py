"""Networks between a robot and its broker that can be impaired and restored while they are in use.

Two network namespaces with a veth pair between them: rate by TBF and loss by nftables, all of it in the kernel. A shell
holds them. When it ends, the devices disappear, and so do the namespaces once they are empty.
"""

from __future__ import annotations

import os
import subprocess
import weakref
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pebble.errors import PebbleError
from pebble.extensions.lab.rig.processes import Worker, end_all
from pebble.extensions.operator.places import SBIN

ROBOT_HOST, REMOTE_HOST = "10.77.0.1", "10.77.0.2"
_WIRE = "wire"  # the device of each namespace
_MTU, _ETHERNET = 1500, 14  # bytes; the second is the header
_BURST = 1600  # bytes: one packet, so that the rate also holds over short times
_QUEUE_S = 0.3  # the queue of a home router's modem, with tail drop
_QUEUE_PACKETS = 4  # at least; at 64 kbit/s 0.3 s hold fewer than two
_COMMAND_S = _ANSWER_S = 10.0

#: Opens the new namespaces as files 3 and 4, says when, and ends with its standard input.
_HOLDER = "exec 3</proc/self/ns/net; exec unshare --net sh -c 'exec 4</proc/self/ns/net; echo {}; read _'"
_TABLE = "table ip impair { chain arriving { type filter hook prerouting priority raw; }; }"


@dataclass(frozen=True, slots=True)
class Condition:
    """The impairment of the network from the robot to its broker."""

    name: str
    kbit: float | None = None  # per second; None: no limit
    loss: float = 0.0  # share of the packets


class NamespaceNetwork(Worker):
    """The network of a robot: a process that holds its namespaces. When it ends, all connections are cut.

    ``on_robot`` and ``on_remote`` wrap a command so that it runs on the robot's or the broker's side. Several
    independent networks may be open at the same time; ``name`` is for messages. Raises PebbleError.
    """

    def __init__(self, name: str = "") -> None:
        log = os.memfd_create("link")  # in memory: nothing is left behind if we are killed
        weakref.finalize(self, os.close, log)
        command = ["unshare", "--net", "sh", "-c", _HOLDER]
        super().__init__(f"network {name}".strip(), command, Path(f"/proc/self/fd/{log}"))
        try:
            self.answer(_ANSWER_S)
            robot, remote = (f"/proc/{self.pid}/fd/{number}" for number in (3, 4))  # see _HOLDER
            self._robot, self._remote = _Side(robot, ROBOT_HOST), _Side(remote, REMOTE_HOST)
            self.on_robot, self.on_remote = self._robot.inside, self._remote.inside
            self._robot.batch("ip", f"link add {_WIRE} type veth peer name {_WIRE} netns {remote}")
            self._robot.set_up()
            self._remote.set_up()
        except BaseException:
            self.close()
            raise

    def apply(self, condition: Condition) -> None:
        """Limit the rate at which the robot sends, and drop a share of what arrives from it. Connections stay."""
        self._robot.batch("tc", f"qdisc replace dev {_WIRE} root {_queue(condition.kbit)}")
        rule = f'iifname != "lo" numgen random mod 10000 < {round(condition.loss * 10000)} counter drop'
        add = f"add rule ip impair arriving {rule}\n" if condition.loss else ""
        self._remote.run("nft", "-f", "-", stdin=f"flush chain ip impair arriving\n{add}")

    def close(self) -> None:
        """Remove the namespaces. May be called repeatedly."""
        end_all([self])


class _Side:
    """A namespace, configured with the system's tools."""

    def __init__(self, path: str, address: str) -> None:
        self._path, self._address = path, address

    def inside(self, command: Sequence[str]) -> list[str]:
        """Return the command line that runs a command on this side, with the same pid and signals."""
        return ["nsenter", f"--net={self._path}", "--", *command]

    def set_up(self) -> None:
        self.batch(
            "ip",
            "link set lo up",
            f"address add {self._address}/30 dev {_WIRE}",
            f"link set {_WIRE} mtu {_MTU} addrgenmode none",  # no IPv6 traffic of its own
            f"link set {_WIRE} gso_max_segs 1",  # otherwise packets of 64 KB are limited and dropped as one
            f"link set {_WIRE} up",
        )
        self.run("nft", "-f", "-", stdin=_TABLE)

    def batch(self, program: str, *lines: str) -> None:
        """Run lines of ``ip`` or ``tc``."""
        self.run(program, "-batch", "-", stdin="".join(f"{line}\n" for line in lines))

    def run(self, program: str, *arguments: str, stdin: str = "") -> None:
        command, what = self.inside([program, *arguments]), f"{program} {' '.join(arguments)}"
        env = {**os.environ, "PATH": f"{os.environ.get('PATH', os.defpath)}:{SBIN}"}
        try:
            done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=_COMMAND_S, env=env)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise PebbleError(f"{what}: {error}") from None
        if done.returncode:
            raise PebbleError(f"{what}: {(done.stderr.strip() or f'code {done.returncode}').splitlines()[0]}")


def _queue(kbit: float | None) -> str:
    """Return the queueing discipline in tc's syntax; without a limit the device's default."""
    if kbit is None:
        return "noqueue"
    rate = kbit * 1000 / 8
    limit = max(rate * _QUEUE_S, _QUEUE_PACKETS * (_MTU + _ETHERNET))
    return f"tbf rate {round(kbit * 1000)}bit burst {round(max(_BURST, rate * 0.005))} limit {round(limit)}"


@cache
def why_no_namespaces() -> str | None:
    """Return why such networks cannot be made here, tested with every feature; None if they can."""
    try:
        with closing(NamespaceNetwork("on trial")) as network:
            network.apply(Condition("trial", kbit=1000, loss=0.01))
    except (PebbleError, OSError) as error:
        return str(error)
    return None
