"""The server's connection to the broker for pictures and sound: what they fill holds up no command and no heartbeat."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from pebble.client.broker import Broker

KEEP_S: Final = 30.0  # after its last use: whoever looks again finds it open


class MediaConnection:
    """Open while anything uses it, and a while longer. Only the event loop calls it."""

    def __init__(self, broker: Broker, keep_s: float = KEEP_S) -> None:
        """``broker`` is closed."""
        self.broker = broker
        self._keep_s = keep_s
        self._users = 0
        self._open = False
        self._changing = asyncio.Lock()
        self._unused: asyncio.TimerHandle | None = None
        self._closing: asyncio.Task[None] | None = None

    @asynccontextmanager
    async def used(self) -> AsyncIterator[None]:
        """Open it, if it is not, and wait a moment for success. Raises TransportError as ``Broker.open`` does."""
        self._users += 1
        if self._unused is not None:
            self._unused.cancel()
        try:
            async with self._changing:
                if not self._open:
                    await self.broker.open()
                    self._open = True
            yield
        finally:
            self._users -= 1
            if not self._users:
                self._unused = asyncio.get_running_loop().call_later(self._keep_s, self._expire)

    async def close(self) -> None:
        """Close it now, unless something uses it."""
        if self._unused is not None:
            self._unused.cancel()
        async with self._changing:
            if self._open and not self._users:
                self._open = False
                await self.broker.close()

    def _expire(self) -> None:
        self._closing = asyncio.ensure_future(self.close())
