"""The stand-in for a bad link where namespaces are not permitted: a TCP proxy in userspace. Loss is modelled."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

import msgspec

from pebble.impair.conditions import Condition
from pebble.impair.helper import Helper
from pebble.impair.link import Carried

LOOPBACK = "127.0.0.1"


class ProxyLink:
    """See pebble.impair.link.Link. Both sides are this machine; only what goes through `broker_address` is impaired."""

    kind = "proxy"
    broker_host = LOOPBACK

    def __init__(self, name: str = "") -> None:
        self._proxy = Helper(f"proxy {name}".strip(), "pebble.impair.proxy_process")
        self._ports: dict[int, int] = {}

    def broker_address(self, port: int) -> tuple[str, int]:
        if port not in self._ports:
            self._ports[port] = int(self._proxy.ask(f"listen {port}")["port"])
        return LOOPBACK, self._ports[port]

    def on_robot(self, command: Sequence[str]) -> list[str]:
        return list(command)

    def on_remote(self, command: Sequence[str]) -> list[str]:
        return list(command)

    def apply(self, condition: Condition) -> None:
        self._proxy.ask(msgspec.json.encode(condition).decode())

    def carried(self) -> Carried:
        return msgspec.convert(self._proxy.ask("count"), Carried)

    def close(self) -> None:
        self._proxy.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()
