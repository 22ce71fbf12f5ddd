"""One medium of each robot on its way to pages: the request while pages use it, and what is shown about it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any, Final, Generic, TypeVar

from starlette.websockets import WebSocket

from pebble.client.broker import Broker
from pebble.client.media_request.source import MediaSource
from pebble.client.viewer import Medium
from pebble.errors import PebbleError
from pebble.media.rate_meter import RateMeter
from pebble.web.robots import Robots

log = logging.getLogger(__name__)

LINGER_S: Final = 5.0  # without viewers, before the request is withdrawn: a page that reloads is back by then
_TICK_S: Final = 0.5
_SILENT_S: Final = 2.0
_SILENT_PERIODS: Final = 3.0
_GONE: Final = 1001  # code of a closed socket

ViewerT = TypeVar("ViewerT")
ViewT = TypeVar("ViewT")


class MediaStream(ABC, Generic[ViewerT, ViewT]):
    """Requests one medium of one robot while it has viewers.

    ``task`` ends once the request is withdrawn; until then viewers may join again.
    """

    def __init__(
        self, broker: Broker, robots: Robots, ref: str, medium: Medium, show: Callable[[str, ViewT], None], view: ViewT
    ) -> None:
        """``show`` tells pages of the robot's view; ``view`` is that of one at rest, which is shown already."""
        self.ref = ref
        self.viewers: set[ViewerT] = set()
        self.refused = 0  # payloads that are nothing of this medium, or too large
        self.view = view  # as shown last
        self._what = "picture" if medium == "video" else "sound"
        self._broker, self._robots, self._show = broker, robots, show
        self._source = MediaSource(broker, ref, medium, self.receive)
        self._meter = RateMeter()
        self._encoding = ""  # of the newest payload
        self._arrived_at: float | None = None
        self._shown_at = float("-inf")
        self._empty_since = time.monotonic()
        self._why = ""  # it is not requested
        self._wakeup = asyncio.Event()
        self._closing = False
        self.task = asyncio.create_task(self._run())

    def join(self, viewer: ViewerT) -> None:
        self.viewers.add(viewer)
        self._wakeup.set()

    def leave(self, viewer: ViewerT) -> None:
        self.viewers.discard(viewer)
        self._empty_since = time.monotonic()
        self._wakeup.set()

    async def close(self) -> None:
        """Withdraw the request now."""
        self._closing = True
        self._wakeup.set()
        await self.task

    # -- of each medium

    @abstractmethod
    def receive(self, payload: bytes) -> None:
        """Give a payload of the robot to all viewers. On the event loop."""

    @abstractmethod
    async def _request(self) -> None:
        """Request what the viewers need; called a few times a second. Raises PebbleError."""

    @abstractmethod
    def _make_view(self, state: str, why: str, rate: float, kbits: float) -> ViewT:
        """What pages are shown."""

    @abstractmethod
    def _end(self) -> None:
        """The request ends; show that it rests."""

    # -- the task

    async def _run(self) -> None:
        try:
            while self.viewers or not self._closing:
                while not self._over():
                    await self._step()
                await self._source.withdraw()
                if self._closing or not self.viewers:  # else one has come meanwhile
                    return
        finally:
            await self._source.withdraw()
            self._end()

    def _over(self) -> bool:
        """A request is not withdrawn while there is no broker: the robot would go on sending afterwards."""
        idle = not self.viewers and time.monotonic() - self._empty_since >= LINGER_S
        return self._closing or (idle and (self._broker.connected or not self._source.started))

    async def _step(self) -> None:
        started = time.monotonic()
        self._report()
        try:
            await self._request()
        except PebbleError as error:
            self._why = str(error)
        self._report()
        await self._pause(started)

    async def _pause(self, started: float) -> None:
        """A step each half second; one that is needed earlier, a tenth of a second after the last one."""
        await asyncio.sleep(max(0.0, started + _TICK_S / 5 - time.monotonic()))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._wakeup.wait(), max(0.001, started + _TICK_S - time.monotonic()))
        self._wakeup.clear()

    # -- what arrives

    def _note(self, encoding: str, size: int, now: float) -> None:
        starts = self._arrived_at is None or encoding != self._encoding
        self._meter.add(now, size)
        self._arrived_at, self._encoding = now, encoding
        if starts:
            self._wakeup.set()

    def _flowing(self, now: float) -> bool:
        if self._arrived_at is None:
            return False
        rate = self._meter.rate(self._arrived_at)
        return now - self._arrived_at <= max(_SILENT_S, _SILENT_PERIODS / rate if rate else 0.0)

    # -- what pages are shown

    def _report(self) -> None:
        """Show what has changed, at most twice a second."""
        now = time.monotonic()
        if now - self._shown_at < _TICK_S:
            return
        state, why = self._state(now)
        flowing = state == "flowing"
        rate = round(self._meter.rate(now), 1) if flowing else 0.0
        kbits = float(round(self._meter.bitrate(now) / 1000)) if flowing else 0.0
        view = self._make_view(state, why, rate, kbits)
        if view != self.view:
            self.view, self._shown_at = view, now
            self._show(self.ref, view)

    def _state(self, now: float) -> tuple[str, str]:
        if self._why:
            return "refused", self._why
        if self._flowing(now):
            return "flowing", self._problem()
        if not self._broker.connected:
            return "silent", f"the server cannot reach the broker: {self._broker.problem}"
        if self._arrived_at is None:
            return "starting", ""
        return "silent", f"no {self._what} for {int(now - self._arrived_at)} s"

    def _problem(self) -> str:
        """What is wrong although it flows."""
        return ""


StreamT = TypeVar("StreamT", bound=MediaStream[Any, Any])


class Streams(Generic[StreamT]):
    """The streams of one medium, by robot; one that has ended is forgotten."""

    def __init__(self, make: Callable[[str], StreamT]) -> None:
        self.closed = False
        self._make = make
        self._streams: dict[str, StreamT] = {}

    def get(self, ref: str) -> StreamT | None:
        """The stream of that robot, if pages use it."""
        return self._streams.get(ref)

    async def serve(
        self,
        websocket: WebSocket,
        ref: str,
        viewer: Any,
        *work: Callable[[StreamT], Coroutine[Any, Any, None]],
    ) -> None:
        """Let the page view that robot until one part of the ``work`` for its socket ends; close the socket."""
        stream = self._open(ref)
        stream.join(viewer)
        tasks = {asyncio.create_task(one(stream)) for one in work}
        try:
            await asyncio.wait({*tasks, stream.task}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            stream.leave(viewer)
            await _end(tasks)
            with contextlib.suppress(RuntimeError):  # it is closed already
                await websocket.close(_GONE)

    async def close(self) -> None:
        """Withdraw all requests; for good."""
        self.closed = True
        await asyncio.gather(*(stream.close() for stream in self._streams.values()), return_exceptions=True)

    def _open(self, ref: str) -> StreamT:
        stream = self._streams.get(ref)
        if stream is None:
            stream = self._streams[ref] = self._make(ref)
            stream.task.add_done_callback(lambda task: self._forget(ref, task))
        return stream

    def _forget(self, ref: str, task: asyncio.Task[None]) -> None:
        self._streams.pop(ref, None)
        if not task.cancelled() and task.exception() is not None:
            log.error("the pictures or the sound of %s have ended", ref, exc_info=task.exception())


async def _end(tasks: set[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    for result in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(result, Exception):
            log.warning("a page's pictures or sound have ended: %s", result)
