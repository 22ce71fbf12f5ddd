"""The impaired network without namespaces: a TCP proxy in userspace that models loss as delay."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

import msgspec

from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.network_process import NetworkProcess, Traffic

LOOPBACK = "127.0.0.1"


class ProxyNetwork:
    """An ImpairedNetwork on loopback; only connections through `broker_address` are impaired."""

    kind = "proxy"
    broker_host = LOOPBACK

    def __init__(self, name: str = "") -> None:
        self._proxy = NetworkProcess(f"proxy {name}".strip(), "pebble.bench.impair.proxy_process")
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

    def traffic(self) -> Traffic:
        return msgspec.convert(self._proxy.ask("count"), Traffic)

    def close(self) -> None:
        self._proxy.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()
