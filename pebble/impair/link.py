"""A link between a robot and its broker that can be made bad, and better again, while both use it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from pebble.errors import PebbleError
from pebble.impair.conditions import Condition

KINDS = ("auto", "namespaces", "proxy")


@dataclass(frozen=True)
class Carried:
    """What has gone over the link since it was opened, with all headers; dropped packets are counted as well.

    What the limited rate had no room for was never on the wire; what was lost, was.
    """

    bytes_up: int = 0
    bytes_down: int = 0
    packets_up: int = 0
    packets_down: int = 0
    dropped_up: int = 0
    dropped_down: int = 0


class Link(Protocol):
    """One robot's link. Several may be open at the same time; they know nothing of each other."""

    kind: str  # "namespaces" or "proxy"
    broker_host: str  # where the broker has to listen, seen from the broker's side

    def broker_address(self, port: int) -> tuple[str, int]:
        """Where the robot finds a broker that listens on ``broker_host:port``."""

    def on_robot(self, command: Sequence[str]) -> list[str]:
        """The command line that runs ``command`` on the robot's side. It becomes that program: pid and signals stay."""

    def on_remote(self, command: Sequence[str]) -> list[str]:
        """The same on the broker's side."""

    def apply(self, condition: Condition) -> None:
        """From now on the link is like this. Connections stay; time in the condition begins at 0."""

    def carried(self) -> Carried: ...

    def close(self) -> None:
        """End it, any number of times. Whoever still uses it is cut off."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None: ...


def open_link(kind: str = "auto", *, name: str = "") -> Link:
    """Of a kind as `resolved` takes it. ``name`` appears in messages. Raises PebbleError if there can be none here."""
    from pebble.impair.namespaces import NamespaceLink
    from pebble.impair.proxy import ProxyLink

    kind, _ = resolved(kind)
    return ProxyLink(name) if kind == "proxy" else NamespaceLink(name)


def resolved(kind: str) -> tuple[str, str | None]:
    """``auto``: namespaces where they are to be had, else the proxy, and why it has to be that.

    Raises PebbleError if there can be no such link here.
    """
    if kind not in KINDS:
        raise PebbleError(f"no kind of link {kind!r}: choose from {', '.join(KINDS)}")
    obstacle = None if kind == "proxy" else why_no_namespaces()
    if kind == "namespaces" and obstacle:
        raise PebbleError(f"no network namespaces: {obstacle}; or choose the proxy")
    return "proxy" if kind == "proxy" or obstacle else "namespaces", obstacle


def why_no_namespaces() -> str | None:
    """What is missing for links of kind ``namespaces``; None: nothing. Raises PebbleError if they do not work."""
    from pebble.impair import namespaces

    return namespaces.obstacle()
