"""A check of each request: its host name, its origin, and its size."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
import socket

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pebble.config.hosts import is_loopback
from pebble.extensions.fleet import certificates
from pebble.extensions.page.setting import WebSettings

MAX_BODY = 16 * 1024  # bytes of a request
BODY_S = 10.0  # for a body to arrive
_METHODS = ("GET", "HEAD", "POST")
_JSON, FORM = "application/json", "application/x-www-form-urlencoded"
STOP_PATH = "/api/estop"  # takes a plain form as well, of a page that does not start
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; "
    "connect-src 'self'; worker-src 'self'; media-src 'self' blob:; manifest-src 'self'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'; frame-src http: https:"  # streams of robots, by a person's click
)
_HOST_AND_PORT = re.compile(r"(\[[0-9a-f:.]+\]|[^\[\]:@/\s]+)(?::\d{1,5})?", re.ASCII | re.IGNORECASE)
#: Added to each response that does not set them itself.
_HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "permissions-policy": "microphone=(self), gamepad=(self), screen-wake-lock=(self), camera=(), geolocation=()",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """ASGI middleware: refuses foreign hosts, foreign origins and large bodies, and adds the security headers.

    SameSite cookies do not keep out a page on another port of the same host, and a host name can be made to resolve to
    this machine: therefore Host must be a known name, or an address, and Origin must be that host for each WebSocket
    and each POST.
    """

    def __init__(self, app: ASGIApp, *, settings: WebSettings) -> None:
        self._app = app
        self._names = host_names(settings)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        elif scope["type"] == "http":
            await self._http(scope, receive, _with_headers(send))
        else:
            await self._app(scope, receive, send)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        if self._is_known(headers) and _is_own_origin(scope, headers):
            await self._app(scope, receive, send)
            return
        await receive()
        await send({"type": "websocket.close", "code": 1008})

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        if refused := self._refusal(scope, headers):
            await _refuse(scope, receive, send, *refused)
            return
        if scope["method"] == "POST":
            try:
                body = await asyncio.wait_for(_body(receive), BODY_S)
            except TimeoutError:
                await _refuse(scope, receive, send, 408, "the body took too long")
                return
            if body is None:
                await _refuse(scope, receive, send, 413, f"the body has more than {MAX_BODY} bytes")
                return
            receive = _replay(body, receive)
        try:
            await self._app(scope, receive, send)
        except asyncio.CancelledError:  # the server ends while it still handles this request
            with contextlib.suppress(RuntimeError):  # its answer has begun
                await _refuse(scope, receive, send, 503, "the server ends")

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """Return the status and text of a refusal; None if the request is allowed."""
        if not self._is_known(headers):
            return 421, "this server has another name; start `pebble web` with --name for each name that it may have"
        if scope["method"] not in _METHODS:
            return 405, "use GET or POST"
        if scope["method"] == "POST":
            if not _is_own_origin(scope, headers):
                return 403, "this request comes from another site"
            takes_form = scope["path"] == STOP_PATH
            kind = content_type(headers)
            if kind != _JSON and not (takes_form and kind == FORM):
                return 415, "send JSON as application/json"
        return None

    def _is_known(self, headers: Headers) -> bool:
        """True if the request has one Host header, with an address or with a name of this server."""
        hosts = headers.getlist("host")
        if len(hosts) != 1 or (host := _without_port(hosts[0])) is None:
            return False
        name = canonical(host)
        wildcard = "*." + name.partition(".")[2]  # certificates may have such names
        return is_address(name) or name in self._names or wildcard in self._names


def content_type(headers: Headers) -> str:
    """Return the content type of a request, without its parameters."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()


def host_names(settings: WebSettings) -> frozenset[str]:
    """Return the names by which browsers may address the server, besides addresses."""
    names = ["localhost"]
    # A name may come with another port, from which requests are forwarded. Host is compared without ports.
    names += filter(None, map(_without_port, settings.names))
    if not is_loopback(settings.host):
        names.append(settings.host)
        if settings.certificate is not None:
            names += certificates.show(settings.certificate).names
        else:
            hostname = socket.gethostname()
            names += [hostname, f"{hostname.partition('.')[0]}.local"]
    return frozenset(map(canonical, names))


def _without_port(host: str) -> str | None:
    """Return the name or address in ``HOST`` or ``HOST:PORT``; None if the text is neither."""
    parts = _HOST_AND_PORT.fullmatch(host)
    return None if parts is None else parts[1]


def is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def canonical(name: str) -> str:
    """Return the canonical spelling of a host name or address."""
    try:
        address = ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return name.lower().rstrip(".")
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)


def _is_own_origin(scope: Scope, headers: Headers) -> bool:
    """True if Origin, which browsers send with each WebSocket and POST, is this server's scheme and host."""
    scheme = {"ws": "http", "wss": "https"}.get(scope["scheme"], scope["scheme"])
    return headers.getlist("origin") == [f"{scheme}://{headers.get('host', '')}".lower()]


async def _body(receive: Receive) -> bytes | None:
    """Return the complete body; None if it is too large."""
    body = bytearray()
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > MAX_BODY:
            return None
        if not message.get("more_body", False):
            return bytes(body)


def _replay(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that first returns ``body``, and then what follows it."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def next_message() -> Message:
        return waiting.pop() if waiting else await receive()

    return next_message


def _with_headers(send: Send) -> Send:
    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return send_with_headers


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, text: str) -> None:
    """Answer with a refusal and close the connection, without reading the rest of the request."""
    await PlainTextResponse(f"{text}\n", status, headers={"connection": "close"})(scope, receive, send)
