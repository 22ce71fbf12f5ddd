"""The routes of the operator page."""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import Lifespan
from starlette.websockets import WebSocket

from pebble.fleet.audit import Audit
from pebble.fleet.people import People
from pebble.web import login
from pebble.web.control import CHECK_S, Control
from pebble.web.guard import Guard
from pebble.web.messages import EstopOp
from pebble.web.server import Server
from pebble.web.settings import WebSettings

_TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "mjs": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "webmanifest": "application/manifest+json",
}
_NO_STORE = {"cache-control": "no-store"}
_FOREVER = {"cache-control": "public, max-age=31536000, immutable"}
_ENCODINGS = frozenset({"json", "pbvd", "pbvz", "h264", "jpeg"})
_VERSION = "{version}"  # in the pages, replaced by that of the files

_estop_decoder = msgspec.json.Decoder(EstopOp)


class StaticFiles:
    """The files of the page, read once: what is not among them cannot be requested."""

    def __init__(self, root: Traversable) -> None:
        self.files = dict(sorted(_read(root, "")))
        digest = hashlib.sha256()
        for name, content in self.files.items():
            digest.update(f"{name}\0{len(content)}\0".encode() + content)
        self.version = digest.hexdigest()[:12]

    def answer(self, name: str, headers: dict[str, str]) -> Response:
        content = self.files.get(name)
        if content is None:
            return PlainTextResponse("not found", 404)
        suffix = name.rpartition(".")[2]
        if suffix == "html":
            content = content.replace(_VERSION.encode(), self.version.encode())
        return Response(content, media_type=_TYPES[suffix], headers=headers)


def _read(folder: Traversable, path: str) -> Any:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _read(entry, f"{path}{entry.name}/")
        elif entry.name.rpartition(".")[2] in _TYPES:
            yield path + entry.name, entry.read_bytes()


def create_app(settings: WebSettings) -> Starlette:
    """The application of one server; it connects to the broker when it starts."""
    static = StaticFiles(files("pebble.web") / "static")
    people = People(settings.people)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        audit = Audit(settings.people)
        server = Server(settings, people, audit)
        app.state.server, app.state.robots, app.state.broker = server, server.robots, server.broker
        app.state.driving, app.state.stops, app.state.media, app.state.audit = (
            server.driving,
            server.stops,
            server.media,
            audit,
        )
        await server.open()
        try:
            yield
        finally:
            await server.close()
            audit.close()

    app = _app(settings, lifespan)
    app.state.settings, app.state.people, app.state.static, app.state.version = settings, people, static, static.version
    return app


def _app(settings: WebSettings, lifespan: Lifespan[Starlette]) -> Starlette:
    return Starlette(
        routes=[
            Route("/", _page),
            Route("/r/{ref:path}", _page),
            Route("/static/{version}/{name:path}", _static),
            Route("/ca.pem", _authority),
            Route("/healthz", _health),
            Route("/api/snapshot.jpg", _snapshot),
            Route("/api/estop", _estop, methods=["POST"]),
            *login.routes(),
            WebSocketRoute("/ws/control", _control),
            WebSocketRoute("/ws/media", _media),
        ],
        lifespan=lifespan,
        middleware=[Middleware(Guard, settings=settings)],
    )


async def _page(request: Request) -> Response:
    if login.session_of(request) is None:
        return Response(status_code=303, headers={"location": "/login", **_NO_STORE})
    return _static_of(request).answer("index.html", _NO_STORE)


async def _static(request: Request) -> Response:
    static = _static_of(request)
    name = request.path_params["name"]
    current = request.path_params["version"] == static.version and not name.endswith(".html")
    return static.answer(name, _FOREVER) if current else PlainTextResponse("not found", 404)


def _static_of(request: Request) -> StaticFiles:
    static: StaticFiles = request.app.state.static
    return static


async def _authority(request: Request) -> Response:
    """The certificate of our authority, which phones are asked to trust; it is public."""
    path = request.app.state.settings.authority
    if path is None or not path.is_file():
        return PlainTextResponse("this server has no certificate authority of its own", 404)
    return Response(path.read_bytes(), media_type="application/x-x509-ca-cert")


async def _health(request: Request) -> Response:
    """200 while there is a broker; says nothing else, because it needs no login."""
    connected = request.app.state.broker.connected
    return PlainTextResponse("ok" if connected else "no broker", 200 if connected else 503, headers=_NO_STORE)


async def _snapshot(request: Request) -> Response:
    if login.session_of(request) is None:
        return PlainTextResponse("log in first", 401)
    picture = await request.app.state.media.snapshot(request.query_params.get("ref", ""))
    if picture is None:
        return PlainTextResponse("no picture flows", 404, headers=_NO_STORE)
    return Response(picture, media_type="image/jpeg", headers=_NO_STORE)


async def _estop(request: Request) -> Response:
    """The way to stop that is left to a page whose control socket is down."""
    session = login.session_of(request)
    if session is None:
        return PlainTextResponse("log in first", 401)
    try:
        op = _estop_decoder.decode(await request.body())
    except (msgspec.MsgspecError, RecursionError) as error:
        return PlainTextResponse(str(error), 400)
    address = "" if request.client is None else request.client.host
    request.app.state.server.stop(op.ref, op.stop, session, "", op.why, address)
    return PlainTextResponse("sent", 202)


async def _control(websocket: WebSocket) -> None:
    session = login.session_of(websocket)
    if session is None:
        await websocket.close(4401)
        return
    await websocket.accept()
    await Control(websocket.app.state.server, websocket, session, lambda: login.session_of(websocket)).serve()


async def _media(websocket: WebSocket) -> None:
    ref = websocket.query_params.get("ref", "")
    if login.session_of(websocket) is None or ref not in websocket.app.state.robots.components:
        await websocket.close(4401)
        return
    await websocket.accept()
    can = frozenset(re.findall(r"[a-z0-9]+", websocket.query_params.get("can", ""))) & _ENCODINGS
    serving = asyncio.ensure_future(websocket.app.state.media.serve(websocket, ref, can))
    try:
        while not (await asyncio.wait({serving}, timeout=CHECK_S))[0]:
            if await asyncio.to_thread(login.session_of, websocket) is None:
                return  # it was revoked
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
