"""A server that shows the operator page in states given as data: for screenshots, and for tests of what people see.

It speaks the control and media sockets as ``pebble web`` does, but there are no robots and no broker behind it.
"""

from __future__ import annotations

import asyncio
import io
import json
import struct
import sys
import threading
import time
import zlib
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import uvicorn
from PIL import Image
from playwright.sync_api import Browser
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from pebble.contract import channel_of
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.media.packets import Picture, PictureKind
from pebble.extensions.operator.client.drive_reasons import WORDS
from pebble.extensions.page.access.guard import CONTENT_SECURITY_POLICY
from pebble.extensions.page.log_lines import line_of
from pebble.extensions.page.messages import FromPage
from pebble.extensions.page.recordings import routes as recordings
from pebble.extensions.page.setting import WebSettings
from pebble.extensions.page.shown import shown
from pebble.extensions.page.static_files import StaticFiles
from pebble.transports import MqttSettings
from tests.ext.page.browser import Size, Tab, tab
from tests.ext.recordings.seek.test_archive import film
from tests.support import ROOT, WAIT_S, free_port, until

PING_S = 0.5
PICTURE_S = 0.1
_decoder = msgspec.json.Decoder(FromPage)

#: Component, metric, payload, and its age in ms.
Value = tuple[str, str, Any, float]


def _shown(metric: str, value: Any) -> Any:
    """Return what the real server lets pages have of it."""
    raw = json.dumps(value).encode()
    return None if value is None else json.loads(shown(channel_of(f"outgoing/{metric}"), raw, value))


@dataclass(frozen=True)
class State:
    """One state of everything behind the page. ``values`` are made anew for each connection from the time in ms."""

    path: str = "/"
    values: Callable[[int], list[Value]] = field(default=lambda _now: [])
    repeated: dict[str, float] = field(default_factory=dict)  # metrics that arrive again and again: seconds between
    welcome: dict[str, Any] = field(default_factory=dict)  # instead of the usual one's fields
    pictures: bool = True  # whether cameras send any
    freezes: bool = False  # pictures end a moment after the first
    silent: bool = False  # the server answers nothing any more once everything is shown
    still: bool = False  # cameras show flat colours, and a few pictures only
    at: int = 0  # ms epoch, at which the server's time stands still; 0: it does not
    logs: Callable[[int], list[Any]] = field(default=lambda _now: [])  # lines of the component that is open
    recordings: bool = False  # of goob a minute is recorded


class CannedServer:
    """Serves the page on a free port of the loopback address, from its own thread."""

    def __init__(self) -> None:
        self.static = StaticFiles(files("pebble.extensions.page") / "static")
        self.port = free_port()
        self.state = State()
        self.received: list[dict[str, Any]] = []  # what pages sent, without the answers to pings
        self.posted: list[tuple[str, Any]] = []
        app = Starlette(
            routes=[
                Route("/", self._page),
                Route("/login", self._page),
                Route("/r/{ref:path}", self._page),
                Route("/replay", self._page),
                Route("/replay/{ref:path}", self._page),
                *recordings.routes(),
                Route("/static/{version}/{name:path}", self._static),
                Route("/stream", self._stream),
                Route("/api/snapshot.jpg", self._snapshot),
                Route("/api/{name}", self._post, methods=["POST"]),
                WebSocketRoute("/ws/control", self._control),
                WebSocketRoute("/ws/media", self._media),
                WebSocketRoute("/ws/replay", self._replay),
            ],
            lifespan=self._life,
        )
        app.state.settings = WebSettings(broker=MqttSettings(host="127.0.0.1"))
        app.state.audit = Audit(None)
        app.state.recordings = None
        self._app = app
        config = uvicorn.Config(app, "127.0.0.1", self.port, log_level="critical", ws_per_message_deflate=False)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        self._thread.start()
        assert until(lambda: self._server.started)

    def close(self) -> None:
        self._server.should_exit = self._server.force_exit = True
        self._thread.join(WAIT_S)

    def show(self, state: State) -> None:
        """What pages that connect from now on are shown."""
        self.state = state
        if state.recordings and self._app.state.recordings is None:
            self._app.state.recordings = recordings.Recordings(Path(_recorded().name))
        self.received.clear()
        self.posted.clear()

    def now(self) -> int:
        """Milliseconds of the epoch."""
        return self.state.at or int(1000 * time.time())

    def sent(self, op: str) -> list[dict[str, Any]]:
        """What pages sent of one kind, without the numbers of commands."""
        messages = [message for message in list(self.received) if message["op"] == op]
        return [{name: value for name, value in message.items() if name != "n"} for message in messages]

    @asynccontextmanager
    async def _life(self, app: Starlette) -> AsyncIterator[None]:
        yield
        app.state.audit.close()
        if app.state.recordings is not None:
            await app.state.recordings.close()

    # -- http

    async def _page(self, request: Request) -> Response:
        return self.static.page(request)

    async def _stream(self, _request: Request) -> Response:
        """A page that a robot may show in a frame."""
        return HTMLResponse(
            "<body style='background: #2a6; color: #fff'>The robot's own stream<script>self.ran = 1</script>"
        )

    async def _static(self, request: Request) -> Response:
        return self.static.answer(request, request.path_params["name"], _headers())

    async def _snapshot(self, request: Request) -> Response:
        """The cameras of other robots than goob rest."""
        age = "0" if request.query_params["ref"].endswith("goob") else "40"
        still = flat() if self.state.still else picture(0)
        return Response(still, media_type="image/jpeg", headers=_headers() | {"age": age})

    async def _post(self, request: Request) -> Response:
        self.posted.append((request.path_params["name"], json.loads(await request.body() or "{}")))  # a form has none
        return JSONResponse({})

    # -- sockets

    async def _control(self, websocket: WebSocket) -> None:
        await websocket.accept()
        state = self.state
        hello = json.loads(await websocket.receive_text())
        self._note(hello)
        if state.silent and len(self.sent("hello")) > 1:
            await _until_closed(websocket)
            return
        await self._send(websocket, self._welcome(state))
        await self._send_state(websocket, state.values(self.now()))
        tasks = [asyncio.ensure_future(self._ping(websocket)), asyncio.ensure_future(self._repeat(websocket, state))]
        try:
            while True:
                message = json.loads(await websocket.receive_text())
                self._note(message)
                if message["op"] == "read-logs" and message["on"]:
                    raw = (line_of(json.dumps(line).encode()) for line in state.logs(self.now()))
                    lines = [json.loads(bytes(line or b"")) for line in raw]
                    logs = {"op": "logs", "ref": message["ref"], "origin": "canned", "first": 213, "lines": lines}
                    await self._send(websocket, logs)
                if message["op"] != "echo" and "n" in message:
                    done = {"op": "done", "cmd": message["op"], "ref": message["ref"], "n": message["n"]}
                    await self._send(websocket, done)
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _replay(self, websocket: WebSocket) -> None:
        await websocket.accept()
        await self._app.state.recordings.viewers.serve(websocket, *recordings.robot_and_time(websocket))

    def _note(self, message: dict[str, Any]) -> None:
        _decoder.decode(json.dumps(message))  # what the real server would refuse is an error here
        if message["op"] != "echo":
            self.received.append(message)

    def _welcome(self, state: State) -> dict[str, Any]:
        usual = {
            "op": "welcome",
            "server": "fair-1",
            "version": self.static.version,
            "user": "alice",
            "role": "driver",
            "rights": ["drive", "reset"],
            "login": True,
            "token": "canned",
            "now": self.now(),
            "drives": True,
            "words": WORDS,
        }
        return usual | state.welcome

    async def _ping(self, websocket: WebSocket) -> None:
        number = 0
        while self.state.silent is False or number < 3:
            number += 1
            await self._send(websocket, {"op": "ping", "n": number, "now": self.now(), "round_trip_ms": 3.0})
            await asyncio.sleep(PING_S)

    async def _repeat(self, websocket: WebSocket, state: State) -> None:
        due = dict.fromkeys(state.repeated, 0.0)
        while not state.silent:
            await asyncio.sleep(0.05)
            now = time.monotonic()
            metrics = {metric for metric, at in due.items() if now >= at}
            due |= {metric: now + state.repeated[metric] for metric in metrics}
            if metrics and (values := [value for value in state.values(self.now()) if value[1] in metrics]):
                await self._send_state(websocket, values)

    async def _send_state(self, websocket: WebSocket, values: list[Value]) -> None:
        vouched = [(ref, metric, _shown(metric, value), age) for ref, metric, value, age in values]
        await self._send(websocket, {"op": "state", "now": self.now(), "set": vouched, "gone": []})

    async def _send(self, websocket: WebSocket, message: dict[str, Any]) -> None:
        if websocket.application_state is WebSocketState.CONNECTED:
            await websocket.send_text(json.dumps(message).replace("{port}", str(self.port)))

    async def _media(self, websocket: WebSocket) -> None:
        await websocket.accept()
        state = self.state
        with suppress(WebSocketDisconnect, RuntimeError):
            for number in range(sys.maxsize):
                if not state.pictures or (number == 3 and (state.freezes or state.still)):
                    await _until_closed(websocket)
                    return
                body = zlib.compress(flat() if state.still else picture(number))
                packet = Picture(PictureKind.ZLIB_JPEG, number + 1, self.now() - 40, body).pack()
                await websocket.send_bytes(struct.pack(">IB", number, 0) + packet)
                await websocket.receive_bytes()  # drawn
                await asyncio.sleep(PICTURE_S)


@cache
def _recorded() -> TemporaryDirectory[str]:
    """Make recordings for all tests of this process, with which they are removed."""
    made = TemporaryDirectory(prefix="pebble-recorded-")
    film(Path(made.name), "json", 60)
    return made


def _headers() -> dict[str, str]:
    return {"content-security-policy": CONTENT_SECURITY_POLICY, "cache-control": "no-store"}


async def _until_closed(websocket: WebSocket) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):
        while True:
            await websocket.receive()


_pictures: list[bytes] = []


def picture(number: int) -> bytes:
    """One of a few JPEG pictures of the simulated world, as from a camera that turns to and fro."""
    if not _pictures:
        whole = Image.open(ROOT / "docs" / "simulated-world.jpg")
        for offset in (0, 8, 16, 8):
            part = whole.crop((offset, 60 + offset // 2, offset + 560, 375 + offset // 2)).resize((640, 360))
            target = io.BytesIO()
            part.save(target, "JPEG", quality=75)
            _pictures.append(target.getvalue())
    return _pictures[number // 10 % len(_pictures)]


def flat() -> bytes:
    """A JPEG picture of a wall, a floor and a box in few colours: its copies are small, and nothing in it is fine."""
    drawn = Image.new("RGB", (640, 360), (205, 195, 184))
    for colour, box in (((96, 104, 112), (0, 240, 640, 360)), ((196, 150, 84), (400, 150, 520, 290))):
        drawn.paste(colour, box)
    target = io.BytesIO()
    drawn.save(target, "JPEG", quality=95)
    return target.getvalue()


@contextmanager
def serving() -> Iterator[CannedServer]:
    """A server that ends with the block."""
    server = CannedServer()
    server.start()
    try:
        yield server
    finally:
        server.close()


#: Opens the page in a state of the server; further options are those of :func:`tests.ext.page.browser.tab`.
Show = Callable[..., AbstractContextManager[Tab]]


@contextmanager
def showing(
    server: CannedServer, browser: Browser, state: State, size: Size = "desktop", *, when: str = "true", **options: Any
) -> Iterator[Tab]:
    """The page in a state of the server, as soon as an expression is true."""
    server.show(state)
    with tab(browser, server.url + state.path, size, **options) as opened:
        assert opened.until(when)
        yield opened
