"""A network between a robot and its broker that can be impaired and restored while both use it."""

from __future__ import annotations

import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgspec

from pebble.bench.impair.conditions import Condition
from pebble.errors import PebbleError
from pebble.rig.worker import Worker, end_workers

KINDS = ("auto", "namespaces", "proxy")
LOOPBACK = "127.0.0.1"
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


class NetworkProcess:
    """Starts ``python -m module`` and waits for its first answer (`greeting`); thread-safe."""

    def __init__(self, name: str, module: str) -> None:
        self._log = os.memfd_create("link")  # the log is an unnamed file: nothing is left behind if we are killed
        self._lock = threading.Lock()
        self._worker = Worker(name, [sys.executable, "-m", module], Path(f"/proc/self/fd/{self._log}"))
        self._open = True
        try:
            self.greeting = self._greeting()
        except BaseException:
            self.close()
            raise

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
                self._close()
                raise

    def close(self) -> None:
        """Ends it, which cuts all connections of the network; may be called repeatedly."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._open:
            self._open = False
            end_workers([self._worker])
            os.close(self._log)

    def _greeting(self) -> dict[str, Any]:
        """The first answer. Raises PebbleError for ``{"error": …}``, UnavailableError for ``{"unavailable": …}``."""
        answer = self._worker.answer(_ANSWER_S)
        if "unavailable" in answer:
            raise UnavailableError(str(answer["unavailable"]))
        if "error" in answer:
            raise PebbleError(str(answer["error"]))
        return answer


class ImpairedNetwork(NetworkProcess, ABC):
    """One robot's network, and the process that impairs it. Several may be open at the same time, independent."""

    kind: str  # "namespaces" or "proxy"
    broker_host: str  # the address on which the broker must listen

    def __init__(self, name: str, module: str) -> None:
        super().__init__(f"network {name}".strip(), module)

    @abstractmethod
    def broker_address(self, port: int) -> tuple[str, int]:
        """The robot's address for a broker that listens on ``broker_host:port``."""

    def on_robot(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the robot's side. The process is replaced: pid and signals stay."""
        return list(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        """Wraps a command so that it runs on the broker's side."""
        return list(command)

    def apply(self, condition: Condition) -> None:
        """Applies a condition. Connections stay; the condition's time starts at 0."""
        self.ask(msgspec.json.encode(condition).decode())

    @abstractmethod
    def traffic(self) -> Traffic: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ProxyNetwork(ImpairedNetwork):
    """A TCP proxy on loopback, which models loss as delay; only connections through `broker_address` are impaired."""

    kind = "proxy"
    broker_host = LOOPBACK

    def __init__(self, name: str = "") -> None:
        super().__init__(name, "pebble.bench.impair.proxy_process")
        self._ports: dict[int, int] = {}

    def broker_address(self, port: int) -> tuple[str, int]:
        if port not in self._ports:
            self._ports[port] = int(self.ask(f"listen {port}")["port"])
        return LOOPBACK, self._ports[port]

    def traffic(self) -> Traffic:
        return msgspec.convert(self.ask("count"), Traffic)


def open_network(kind: str = "auto", *, name: str = "") -> ImpairedNetwork:
    """Opens a network of a kind as in `resolved`; ``name`` is for messages. Raises PebbleError if it is unavailable."""
    from pebble.bench.impair.namespaces import NamespaceNetwork

    kind, _ = resolved(kind)
    return ProxyNetwork(name) if kind == "proxy" else NamespaceNetwork(name)


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


def why_no_namespaces() -> str | None:
    """What prevents networks of kind ``namespaces``; None: nothing. Raises PebbleError if they fail."""
    from pebble.bench.impair import namespaces

    return namespaces.obstacle()
