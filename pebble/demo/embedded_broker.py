"""Program: ``python -m pebble.demo.embedded_broker PORT``: amqtt on loopback, for machines without mosquitto."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator
from typing import Any

from amqtt.broker import Broker


class _Subscriptions(dict[str, Any]):
    """May grow while somebody goes through it.

    amqtt (0.12.1) goes through its subscriptions and lets other tasks run meanwhile. Where one of them adds a filter,
    Python ends the loop: a client that connects just then has its CONNACK and is never listened to, and a message that
    is handed out just then misses some of those it is for. Measured: one in five runs of the demo lost its sound so.
    """

    def __iter__(self) -> Iterator[str]:
        return iter(list(self.keys()))

    def items(self) -> Any:
        return list(super().items())


async def serve(port: int) -> None:
    """Until the task is cancelled."""
    broker = Broker(
        {
            "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
            "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
        }
    )
    broker._subscriptions = _Subscriptions()
    await broker.start()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1])))
