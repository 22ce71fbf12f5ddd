"""The impaired network without namespaces: a TCP proxy in userspace that models loss as delay."""

from __future__ import annotations

import msgspec

from pebble.bench.impair.network import ImpairedNetwork
from pebble.bench.impair.network_process import Traffic

LOOPBACK = "127.0.0.1"


class ProxyNetwork(ImpairedNetwork):
    """On loopback; only connections through `broker_address` are impaired."""

    kind = "proxy"
    broker_host = LOOPBACK

    def __init__(self, name: str = "") -> None:
        super().__init__(name, "pebble.bench.impair.proxy_process")
        self._ports: dict[int, int] = {}

    def broker_address(self, port: int) -> tuple[str, int]:
        if port not in self._ports:
            self._ports[port] = int(self.process.ask(f"listen {port}")["port"])
        return LOOPBACK, self._ports[port]

    def traffic(self) -> Traffic:
        return msgspec.convert(self.process.ask("count"), Traffic)
