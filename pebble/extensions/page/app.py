"""The routes of the operator page."""

from __future__ import annotations

import asyncio
import html
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qsl, quote

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Session, page_rights
from pebble.extensions.page.access import login
from pebble.extensions.page.access.guard import FORM, STOP_PATH, Guard, content_type
from pebble.extensions.page.control import CHECK_S, Control
from pebble.extensions.page.messages import EstopOp
from pebble.extensions.page.recordings import routes as recordings
from pebble.extensions.page.recordings.routes import Recordings
from pebble.extensions.page.server import PEOPLE_S, TICK_S, Server
from pebble.extensions.page.setting import WebSettings
from pebble.extensions.page.static_files import FOREVER, NO_STORE, StaticFiles, root_of

_AUDIT_ROWS = 200  # that a page shows; `pebble web audit` prints more
_CONFIRM_S = 1.5  # so long robots have to confirm a stop before the answer to a form says what they did
_MOST_NAMED = 20  # robots in that answer
_ENCODINGS = frozenset({"json", "pbvd", "h264", "jpeg"})
_estop_decoder = msgspec.json.Decoder(EstopOp)


@cache
def page_files() -> StaticFiles:
    """Return the page's compressed files, shared by all servers of a process."""
    return StaticFiles(files("pebble.extensions.page") / "static")


def create_app(settings: WebSettings) -> Starlette:
    """Return the application of one server; it connects to the broker when it starts."""
    static = page_files()
    people = People(settings.people)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        audit = Audit(settings.people)
        archive = None if settings.recordings is None else Recordings(settings.recordings)
        server = Server(settings, people, audit)
        app.state.server, app.state.audit, app.state.recordings = server, audit, archive
        await server.open()
        try:
            yield
        finally:
            await server.close()
            audit.close()
            if archive is not None:
                await archive.close()

    app = Starlette(
        routes=[
            Route("/", _page),
            Route("/r/{ref:path}", _page),
            Route("/replay", _page),
            Route("/replay/{ref:path}", _page),
            Route("/static/{version}/{name:path}", _static),
            Route("/ca.pem", _authority),
            Route("/healthz", _health),
            Route("/api/snapshot.jpg", _snapshot),
            Route(STOP_PATH, _estop, methods=["POST"]),
            Route("/api/audit", _audit),
            *login.routes(),
            *recordings.routes(),
            WebSocketRoute("/ws/control", _control),
            WebSocketRoute("/ws/media", _media),
            WebSocketRoute("/ws/sound", _sound),
            WebSocketRoute("/ws/replay", _replay),
        ],
        lifespan=lifespan,
        middleware=[Middleware(Guard, settings=settings)],
    )
    app.state.settings, app.state.people = settings, people
    app.state.static, app.state.version = static, static.version
    return app


async def _page(request: Request) -> Response:
    if login.session_of(request) is None:
        wanted = request.url.path + ("?watch" if "watch" in request.query_params else "")
        query = "" if wanted == "/" else f"?next={quote(wanted)}"
        return Response(status_code=303, headers={"location": f"{root_of(request)}login{query}", **NO_STORE})
    return _static_of(request).page(request)


async def _static(request: Request) -> Response:
    static = _static_of(request)
    name = request.path_params["name"]
    current = static.is_current(request.path_params["version"]) and not name.endswith(".html")
    return static.answer(request, name, FOREVER) if current else PlainTextResponse("not found", 404)


def _static_of(request: Request) -> StaticFiles:
    static: StaticFiles = request.app.state.static
    return static


async def _authority(request: Request) -> Response:
    """Answer with the certificate of our authority, which phones are asked to trust and which is public."""
    path = request.app.state.settings.authority
    content = b"" if path is None or not path.is_file() else certificates.only_certificates(path.read_bytes())
    if not content:
        return PlainTextResponse("this server has no certificate authority of its own", 404)
    return Response(content, media_type="application/x-x509-ca-cert")


async def _health(request: Request) -> Response:
    """Answer 200 while the broker is connected, and nothing more: this needs no login."""
    connected = _server_of(request).broker.connected
    return PlainTextResponse("ok" if connected else "no broker", 200 if connected else 503, headers=NO_STORE)


async def _snapshot(request: Request) -> Response:
    if login.session_of(request) is None:
        return PlainTextResponse("log in first", 401)
    ref, server = request.query_params.get("ref", ""), _server_of(request)
    if ref not in server.robots.components:
        return PlainTextResponse("no such component", 404)
    still = await server.pictures.snapshot(ref)
    if still is None:
        return Response(status_code=204, headers=NO_STORE)
    jpeg, received_at = still
    headers = {**NO_STORE, "age": str(round(time.monotonic() - received_at))}
    return Response(jpeg, media_type="image/jpeg", headers=headers)


async def _estop(request: Request) -> Response:
    """Stop robots for a page whose control socket is closed or, as a plain form, for a page that did not start."""
    is_form = content_type(request.headers) == FORM
    answer = _stopped_page if is_form else _plain
    session = login.session_of(request)
    if session is None:
        return answer(request, 401, "log in first")
    try:
        op = await _estop_op(request, is_form=is_form)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        return answer(request, 400, str(error))
    server = _server_of(request)
    server.stop(op.ref, op.stop, session, "", op.why, login.address_of(request))  # "": the device is not known
    if not is_form:
        return _plain(request, 202, "sent")
    until = time.monotonic() + _CONFIRM_S  # a page that did not start shows nothing after this answer
    while server.stops.robots_of(op.stop).unconfirmed and time.monotonic() < until:
        await asyncio.sleep(TICK_S)
    return _stopped_page(request, 202, _stop_words(server, op.stop))


async def _estop_op(request: Request, *, is_form: bool) -> EstopOp:
    if not is_form:
        return _estop_decoder.decode(await request.body())
    fields = dict(parse_qsl((await request.body()).decode()))
    return msgspec.convert({"ref": "", "stop": secrets.token_hex(8), "why": "form", **fields, "op": "estop"}, EstopOp)


def _stop_words(server: Server, name: str) -> str:
    """Return in words which robots have confirmed the stop with this name."""
    if not server.broker.connected:
        return "NOT SENT YET: the server cannot reach the broker."
    confirmed, unconfirmed = server.stops.robots_of(name)
    words = "Sent, and repeated for a minute until all have confirmed it."
    if not confirmed and not unconfirmed:
        words += " No robot has been heard of yet: assume that they move."
    if confirmed:
        words += f" Confirmed by {len(confirmed)} of {len(confirmed) + len(unconfirmed)}."
    if unconfirmed:
        more = " …" if len(unconfirmed) > _MOST_NAMED else ""
        words += f" NOT CONFIRMED yet by {', '.join(unconfirmed[:_MOST_NAMED])}{more}"
    return words


def _plain(_request: Request, status: int, text: str) -> Response:
    return PlainTextResponse(text, status)


def _stopped_page(request: Request, status: int, text: str) -> Response:
    static = _static_of(request)
    page = static.files["stopped.html"].decode()
    page = page.replace("{root}", root_of(request)).replace("{text}", html.escape(text))
    return HTMLResponse(page, status, headers={**NO_STORE, "referrer-policy": "same-origin"})


async def _audit(request: Request) -> Response:
    """Answer with the newest rows of this server's audit about one robot, for those who maintain robots."""
    session, server = login.session_of(request), _server_of(request)
    if session is None:
        return PlainTextResponse("log in first", 401)
    if "system" not in page_rights(session.role, server.settings.level):
        return PlainTextResponse(f"The role {session.role} may not do this", 403)
    try:
        rows = await asyncio.to_thread(server.audit.read, _AUDIT_ROWS, request.query_params.get("ref", ""))
    except DatabaseError as error:
        return PlainTextResponse(str(error), 503, headers=NO_STORE)
    return Response(msgspec.json.encode(rows), media_type="application/json", headers=NO_STORE)


def _server_of(connection: HTTPConnection) -> Server:
    server: Server = connection.app.state.server
    return server


async def _control(websocket: WebSocket) -> None:
    session = login.session_of(websocket)
    if session is None:
        await websocket.close(4401)
        return
    await websocket.accept()
    await Control(_server_of(websocket), websocket, session, lambda: login.session_of(websocket)).serve()


async def _media(websocket: WebSocket) -> None:
    media = _server_of(websocket).pictures
    await _serve(websocket, lambda ref, decodes, _: media.serve(websocket, ref, decodes & _ENCODINGS))


async def _sound(websocket: WebSocket) -> None:
    sound = _server_of(websocket).sound
    device, address = login.printable(websocket.query_params.get("device", "")), login.address_of(websocket)
    await _serve(websocket, lambda ref, plays, session: sound.serve(websocket, ref, plays, session, device, address))


async def _replay(websocket: WebSocket) -> None:
    """Play a recording for one page, while its session is valid. Nothing is sent to a robot."""
    archive: Recordings | None = websocket.app.state.recordings
    session = login.session_of(websocket)
    if session is None or archive is None:
        await websocket.close(4401)
        return
    try:
        ref, at_ms = recordings.robot_and_time(websocket)
    except recordings.BadQuestionError as error:
        await websocket.close(4400, str(error)[:100])
        return
    await websocket.accept()
    await _while_allowed(websocket, session, archive.viewers.serve(websocket, ref, at_ms))


async def _serve(
    websocket: WebSocket, serve: Callable[[str, frozenset[str], Session], Coroutine[Any, Any, None]]
) -> None:
    """Serve a component's pictures or sound, while the session is valid.

    ``serve`` gets the component, the encodings that the page can decode, and the session.
    """
    ref, session = websocket.query_params.get("ref", ""), login.session_of(websocket)
    if session is None or ref not in _server_of(websocket).robots.components:
        await websocket.close(4401)
        return
    await websocket.accept()
    encodings = frozenset(re.findall(r"[a-z0-9]+", websocket.query_params.get("can", "")))
    await _while_allowed(websocket, session, serve(ref, encodings, session))


async def _while_allowed(websocket: WebSocket, session: Session, work: Coroutine[Any, Any, None]) -> None:
    """Run the work of a socket until it is done, or the session is revoked.

    The session is checked soon after people or sessions have changed, and every few seconds in any case.
    """
    server = _server_of(websocket)
    checked_version, check_at = server.people_version, time.monotonic() + CHECK_S
    serving = asyncio.ensure_future(work)
    try:
        while not serving.done():
            await asyncio.wait({serving}, timeout=PEOPLE_S)
            if checked_version == server.people_version and time.monotonic() < check_at:
                continue
            checked_version, check_at = server.people_version, time.monotonic() + CHECK_S
            present = await asyncio.to_thread(login.session_of, websocket)
            if present is None or present.role != session.role:
                return  # it was revoked
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
