"""One robot's pictures or sound, requested while they are wanted and a while longer, however many want them."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from typing import Any, Final

from pebble.client.broker import Broker
from pebble.client.media_request.source import MediaSource, refusal
from pebble.client.viewer import Medium
from pebble.errors import PebbleError

LINGER_S: Final = 5.0  # unwanted, before the request is withdrawn: a page that reloads is back by then
TICK_S: Final = 0.5


class MediaRequest:
    """The request for one medium of one robot. Only the event loop calls it."""

    def __init__(self, broker: Broker, ref: str, medium: Medium, receive: Callable[[bytes], None]) -> None:
        """``receive`` gets each payload."""
        self.ref, self.medium = ref, medium
        self.problem = ""  # why it is not requested
        self._broker = broker
        self._source = MediaSource(broker, ref, medium, receive)
        self._wanted = self._closing = False
        self._wanted_at = float("-inf")  # the last time
        self._wakeup = asyncio.Event()

    @property
    def encoding(self) -> str | None:
        """The encoding that was requested; None: as configured, or nothing is requested."""
        return self._source.encoding

    @property
    def requested_at(self) -> float:
        """When that was (monotonic)."""
        return self._source.requested_at

    def want(self, wanted: bool) -> None:
        """Say whether anything shows or plays it now."""
        if wanted or self._wanted:
            self._wanted_at = time.monotonic()
        self._wanted = wanted
        self.wake()

    def wake(self) -> None:
        """Take the next step soon."""
        self._wakeup.set()

    def close(self) -> None:
        """Let :meth:`run` end now."""
        self._closing = True
        self.wake()

    async def wait_until_wanted(self) -> None:
        while not self._wanted:
            self._wakeup.clear()
            await self._wakeup.wait()

    async def run(self, step: Callable[[], Awaitable[None]]) -> None:
        """Await ``step`` twice a second, and soon if it is woken, until nothing has wanted the request for a while.

        At the end, also if it is cancelled, the request is withdrawn.
        """
        try:
            while not self._closing:
                if not self._is_over():
                    began = time.monotonic()
                    await step()
                    await self._pause(began)
                    continue
                await self._source.withdraw()
                if self._is_over():  # else something has come to want it meanwhile
                    return
        finally:
            await self._source.withdraw()

    async def follow(self, capabilities: dict[str, Any], encoding: Callable[[], str | None]) -> None:
        """Request it if it is wanted, as these capabilities allow it, in ``encoding()``; call it with each step."""
        self.problem = refusal(self.ref, capabilities, self.medium)
        if self.problem:
            await self._source.withdraw()
            return
        chosen = encoding()
        if not self._wanted:
            return
        try:
            await self._source.follow(capabilities, chosen)
        except PebbleError as error:
            self.problem = str(error)

    async def request_keyframe(self, encoding: str) -> None:
        """Request a key frame in the encoding that arrives; one passes each second."""
        await self._source.request_keyframe(encoding)

    def _is_over(self) -> bool:
        """A request is not withdrawn while there is no broker: the robot would go on sending afterwards."""
        idle = not self._wanted and time.monotonic() - self._wanted_at >= LINGER_S
        return idle and (self._broker.connected or not self._source.started)

    async def _pause(self, began: float) -> None:
        """A step that is needed earlier comes a tenth of a second after the last one."""
        await asyncio.sleep(max(0.0, began + TICK_S / 5 - time.monotonic()))
        with contextlib.suppress(TimeoutError):  # wait_for of Python 3.11 loses a cancellation that meets a wakeup
            async with asyncio.timeout(max(0.001, began + TICK_S - time.monotonic())):
                await self._wakeup.wait()
        self._wakeup.clear()
