"""A network between a robot and its broker that can be impaired and restored while both use it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

import msgspec

from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.network_process import NetworkProcess, Traffic
from pebble.errors import PebbleError

KINDS = ("auto", "namespaces", "proxy")


class ImpairedNetwork(ABC):
    """One robot's network. Several may be open at the same time, independent of each other.

    A context manager; ``process`` is what impairs.
    """

    kind: str  # "namespaces" or "proxy"
    broker_host: str  # the address on which the broker must listen

    def __init__(self, name: str, module: str) -> None:
        self.process = NetworkProcess(f"network {name}".strip(), module)

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
        self.process.ask(msgspec.json.encode(condition).decode())

    @abstractmethod
    def traffic(self) -> Traffic: ...

    def close(self) -> None:
        """Closes the network and cuts all connections; may be called repeatedly."""
        self.process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_network(kind: str = "auto", *, name: str = "") -> ImpairedNetwork:
    """Opens a network of a kind as in `resolved`; ``name`` is for messages. Raises PebbleError if it is unavailable."""
    from pebble.bench.impair.namespaces import NamespaceNetwork
    from pebble.bench.impair.proxy import ProxyNetwork

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
