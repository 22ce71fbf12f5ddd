"""The server of the operator page, as a process in virtual time: the real Server and Control, on sockets in memory."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from starlette.websockets import WebSocketDisconnect, WebSocketState

from pebble.contract import DRIVE, codec
from pebble.extensions.fleet.roles import Role, Session
from pebble.extensions.operator.client import broker
from pebble.extensions.page import control, robots, server
from pebble.extensions.page.drive import drivers, refusals
from pebble.extensions.page.setting import WebSettings
from pebble.transports import MqttSettings
from pebble.transports import clock as message_clock
from tests.ext.page.driving_lockstep.pages import EPOCH
from tests.ext.page.driving_lockstep.virtual_loop import VirtualLoop
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.processes import Process

VERSION = "1"
BOOT_S = 0.2


class _Time:
    """A stand-in for the module ``time``."""

    def __init__(self) -> None:
        self.clock: Callable[[], float] = lambda: 0.0

    def monotonic(self) -> float:
        return self.clock()

    def time(self) -> float:
        return EPOCH + self.clock()


class _Nothing:
    """A stand-in for what has nothing to do with driving: pictures, people, the audit log."""

    def __init__(self, *_: Any) -> None:
        self._values: dict[str, str] = {}

    def write(self, *_: Any, **__: Any) -> None: ...

    def pin(self, ref: str, encoding: str) -> None: ...

    def get(self, key: str) -> str | None:
        return self._values.get(key)

    def all(self, _prefix: str) -> dict[str, str]:
        return {}

    def set(self, key: str, value: str) -> None:
        self._values[key] = value

    async def close(self) -> None: ...


TIME = _Time()


@contextmanager
def virtual() -> Iterator[None]:
    """Replace the clocks and the random numbers of the server's modules."""
    numbers = iter(range(1, 1 << 62))
    secrets = SimpleNamespace(
        token_hex=lambda size: f"{next(numbers):0{2 * size}x}", token_urlsafe=lambda _: f"token-{next(numbers)}"
    )
    with ExitStack() as stack:
        for module in (server, refusals, robots, control, broker):
            stack.enter_context(patch.object(module, "time", TIME))
        for module in (server, drivers, control):
            stack.enter_context(patch.object(module, "clock", TIME.monotonic))
        stack.enter_context(patch.object(message_clock, "since_boot", TIME.monotonic))
        for module in (server, control, broker):
            stack.enter_context(patch.object(module, "secrets", secrets))
        stack.enter_context(patch.object(server, "MediaHub", _Nothing))
        yield


class BrokerConnection(Connection):
    """The server's connection to the broker. ``rewrite`` may replace a drive command by another one."""

    rewrite: Callable[[Any], Any]

    def open(self, timeout: float = 0.0) -> Any:
        return super().open(0.0)

    def publish(self, topic: str, payload: bytes, **options: Any) -> bool:
        if topic.endswith(f"/{DRIVE.metric}"):
            payload = codec.encode(DRIVE, self.rewrite(topic, codec.decode(DRIVE, payload)))
        return super().publish(topic, payload, **options)


class ServerSocket:
    """The server's end of a control connection; ``send`` and ``closed`` lead to the page."""

    def __init__(self, loop: VirtualLoop, send: Callable[[str], None], closed: Callable[[int], None]) -> None:
        self._loop, self._send, self._closed = loop, send, closed
        self._waiting: deque[dict[str, Any]] = deque()
        self._reader: asyncio.Future[None] | None = None
        self._gone = False
        self.application_state = WebSocketState.CONNECTED
        self.url = SimpleNamespace(scheme="ws")
        self.client = SimpleNamespace(host="127.0.0.1")
        self.app = SimpleNamespace(state=SimpleNamespace(version=VERSION))

    def arrive(self, text: str | None) -> None:
        """A message of the page; None: the connection has ended."""
        if text is None:
            self._gone = True
            self._waiting.append({"type": "websocket.disconnect"})
        else:
            self._waiting.append({"type": "websocket.receive", "text": text})
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(None)

    async def receive(self) -> dict[str, Any]:
        while not self._waiting:
            self._reader = self._loop.create_future()
            await self._reader
        return self._waiting.popleft()

    async def send_text(self, text: str) -> None:
        if self._gone:
            raise WebSocketDisconnect
        self._send(text)

    async def close(self, code: int = 1000) -> None:
        self.application_state = WebSocketState.DISCONNECTED
        self._closed(code)
        self.arrive(None)


class WebServer(Process):
    """``handled(control, op)`` is called around each message of a page, before and after."""

    def __init__(self, network: Network, rewrite: Callable[[Any], Any], handling: Callable[..., Any]) -> None:
        super().__init__("web", network.scheduler)
        self.lives = 0
        self.roles: dict[int, Role] = {}
        self.base = ""  # of the robot that the rules are about
        self.lease_moved: Callable[[Any], None] = lambda tab: None
        self._network, self._rewrite, self._handling = network, rewrite, handling
        self._restart = 0
        self.loop: VirtualLoop | None = None
        self.server: Any = None

    def start(self) -> None:
        if self.alive:
            return
        self.alive = True
        self.lives += 1
        self.loop = VirtualLoop(self.scheduler.clock)
        with patch.object(broker, "create", self._connection):
            self.server = server.Server(
                WebSettings(broker=MqttSettings(host="fair"), server="fair"), _Nothing(), _Nothing()
            )  # type: ignore[arg-type]
        drivers = self.server.drivers
        drivers.updated, drivers.tick = self._watched(drivers.updated), self._watched(drivers.tick)
        self.loop.create_task(self.server.open())
        self.wake()

    def _connection(self, *_: Any) -> BrokerConnection:
        connection = BrokerConnection(self, self._network)
        connection.rewrite = self._rewrite
        return connection

    def driven(self, ref: str) -> Any:
        """Who drives that robot, as the server knows it."""
        return self.server.drivers.robot(ref)

    def _watched(self, method: Callable[[Any], None]) -> Callable[[Any], None]:
        """The method of the server's drivers, after which the rules see whether a page has lost control by it."""

        def watched(argument: Any) -> None:
            tab = self.driven(self.base).tab
            method(argument)
            if tab is not None and self.driven(self.base).tab is not tab:
                self.lease_moved(tab)

        return watched

    def kill(self, restart_s: float | None) -> None:
        """End at once: nothing is published any more."""
        if not self.alive:
            return
        self.leave()
        self.end()
        if restart_s is not None:
            self._restart += 1
            restart = self._restart
            self.scheduler.after(restart_s, lambda: restart == self._restart and self.start())

    def end(self) -> None:
        """Free what the last life has left."""
        if self.loop is not None:
            self.loop.end()
            self.loop = None

    def accept(self, page: int, socket: ServerSocket) -> None:
        """Serve a connection of a page."""
        assert self.loop is not None
        session = Session(f"session-{page}", f"human-{page}", self.roles.get(page % 8, Role.MAINTAINER))

        def check() -> Session | None:
            return Session(session.id, session.user, self.roles.get(page % 8, Role.MAINTAINER))

        one = RecordedControl(self.server, socket, session, check)  # type: ignore[arg-type]
        one.page, one.handling = page, self._handling
        self.loop.create_task(one.serve())
        self.wake()

    def turn(self) -> None:
        assert self.loop is not None
        self.loop.turn()
        due = self.loop.due
        if due is not None:
            self.turn_at(due + self.latency)


class RecordedControl(control.Control):
    """A control connection whose messages the rules see."""

    page = -1
    handling: Callable[..., Any]

    def _handle(self, op: Any) -> None:
        self.handling(self, op, True)
        try:
            super()._handle(op)
        finally:
            self.handling(self, op, False)

    def _end(self) -> None:
        self.handling(self, None, True)
        try:
            super()._end()
        finally:
            self.handling(self, None, False)
