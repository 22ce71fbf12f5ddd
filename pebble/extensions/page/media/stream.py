"""A medium of one robot on its way to pages: the request for it while pages use it, and its state for pages."""

import asyncio
import contextlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any, Final, Generic, TypeVar

from starlette.websockets import WebSocket

from pebble.contract import OUTGOING, Channel
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.media_request.shared import TICK_S, SharedRequest
from pebble.extensions.operator.client.robot_topics import own_topic
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page.robots import Robots

log = logging.getLogger(__name__)

_WHAT: Final[dict[Medium, str]] = {"video": "picture", "audio": "sound"}
_SILENT_S, _SILENT_PERIODS = 2.0, 3.0  # see Arrivals.flowing
_GONE, _BAD_REQUEST = 1001, 4400  # codes of a closed socket

ViewerT = TypeVar("ViewerT")
ViewT = TypeVar("ViewT")


class Arrivals:
    """The arrivals of a medium's payloads: encoding, rate, and whether they continue. Pure: times are passed in."""

    def __init__(self) -> None:
        self.encoding = ""  # of the newest payload
        self.meter = RateMeter()
        self._newest_at: float | None = None

    def add(self, encoding: str, size: int, now: float) -> bool:
        """Note a payload; return True if its encoding differs from the previous one."""
        is_new_encoding = self._newest_at is None or encoding != self.encoding
        self.meter.add(now, size)
        self._newest_at, self.encoding = now, encoding
        return is_new_encoding

    def quiet_s(self, now: float) -> float | None:
        """Return for how long nothing has arrived; None if nothing ever has."""
        return None if self._newest_at is None else now - self._newest_at

    def flowing(self, now: float) -> bool:
        """True if payloads arrive: a silence counts after 2 s or, if they are rare, after three of their periods."""
        if self._newest_at is None:
            return False
        rate = self.meter.rate(self._newest_at)
        silence_s = max(_SILENT_S, _SILENT_PERIODS / rate) if rate else _SILENT_S
        return now - self._newest_at <= silence_s


class MediaStream(ABC, Generic[ViewerT, ViewT]):
    """The request for a robot's medium while it has viewers.

    ``task`` ends once the request is withdrawn; until then viewers may join again.
    """

    def __init__(self, broker: Broker, robots: Robots, ref: str, medium: Medium, metric: str, view: ViewT) -> None:
        """Store the arguments. ``metric``: the state for pages; ``view``: its value while nothing is requested."""
        self.ref = ref
        self.viewers: set[ViewerT] = set()
        self.view = self._at_rest = view  # as shown last
        self._shown_at = float("-inf")
        self._broker, self._robots, self._metric = broker, robots, metric
        self._request = SharedRequest(broker, ref, medium, self.receive)
        self._arrivals = Arrivals()
        self.task = asyncio.create_task(self._run())

    def join(self, viewer: ViewerT) -> None:
        self.viewers.add(viewer)
        self._request.want(True)

    def leave(self, viewer: ViewerT) -> None:
        self.viewers.discard(viewer)
        self._request.want(bool(self.viewers))

    async def close(self) -> None:
        """Withdraw the request now."""
        self._request.close()
        await self.task

    @property
    def robot(self) -> RobotView:
        """Return the view of the robot, if it is known."""
        return self._robots.view(self.ref) or RobotView(self.ref)

    # -- of each medium

    @abstractmethod
    def receive(self, payload: bytes) -> None:
        """Pass a payload to all viewers. On the event loop."""

    @abstractmethod
    async def _follow(self) -> None:
        """Request what the viewers need. Called a few times a second."""

    @abstractmethod
    def _make_view(self, state: str, why: str, rate: float, kbits: float) -> ViewT:
        """Return the medium's state for pages."""

    def _end(self) -> None:
        """Note that the request has ended."""

    # -- the task

    async def _run(self) -> None:
        try:
            await self._request.run(self._step)
        finally:
            self._end()
            self._show(self._at_rest)

    async def _step(self) -> None:
        self._report()
        await self._follow()
        self._report()

    def _note(self, encoding: str, size: int, now: float) -> None:
        if self._arrivals.add(encoding, size, now):
            self._request.wake()

    # -- what pages are shown

    def _report(self) -> None:
        """Publish changes to pages, at most twice a second."""
        now = time.monotonic()
        if now - self._shown_at < TICK_S:
            return
        state, why = self._state(now)
        flowing = state == "flowing"
        rate = round(self._arrivals.meter.rate(now), 1) if flowing else 0.0
        kbits = float(round(self._arrivals.meter.bitrate(now) / 1000)) if flowing else 0.0
        view = self._make_view(state, why, rate, kbits)
        if view != self.view:
            self.view, self._shown_at = view, now
            self._show(view)

    def _show(self, view: ViewT) -> None:
        if self._robots.capabilities(self.ref):
            self._robots.set_server_metric(self.ref, self._metric, view)

    def _state(self, now: float) -> tuple[str, str]:
        """Return the medium's state, and why it is no better, for people."""
        if self._request.problem:
            return "refused", self._request.problem
        if self._arrivals.flowing(now):
            return "flowing", self._problem()
        if self._request.waits:
            return "held", self._request.waits
        if not self._broker.connected:
            what = _WHAT[self._request.medium]
            return "silent", f"no connection to the broker for the {what}: {self._broker.problem}"
        quiet_s = self._arrivals.quiet_s(now)
        if quiet_s is None:
            return "starting", ""
        return "silent", f"no {_WHAT[self._request.medium]} for {int(quiet_s)} s"

    def _problem(self) -> str:
        """Return the problem of a medium whose payloads arrive; empty if there is none."""
        return ""


StreamT = TypeVar("StreamT", bound=MediaStream[Any, Any])


class Streams(Generic[StreamT]):
    """The streams of one medium, by robot. An ended one is forgotten."""

    def __init__(self, channel: Channel, make: Callable[[str], StreamT]) -> None:
        self._channel, self._make = channel, make
        self._closed = False
        self._streams: dict[str, StreamT] = {}

    def get(self, ref: str) -> StreamT | None:
        """Return that robot's stream, if pages use it."""
        return self._streams.get(ref)

    async def let_view(
        self, websocket: WebSocket, ref: str, viewer: Any, *work: Callable[[StreamT], Coroutine[Any, Any, None]]
    ) -> None:
        """Serve a page's socket while it views that robot, until one part of ``work`` ends; then close the socket."""
        if self._closed or not own_topic(ref, self._channel.topic(ref), OUTGOING):
            await websocket.close(_BAD_REQUEST, "no such component")
            return
        stream = self._open(ref)
        stream.join(viewer)
        tasks = {asyncio.create_task(part(stream)) for part in work}
        try:
            await asyncio.wait({*tasks, stream.task}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            stream.leave(viewer)
            await _end(tasks)
            with contextlib.suppress(RuntimeError):  # it is closed already
                await websocket.close(_GONE)

    async def close(self) -> None:
        """Withdraw all requests for good."""
        self._closed = True
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
