"""The first to see each request: which host it names, where it comes from, and how large it is."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pebble.client.page import WebSettings
from pebble.fleet import certificates

MAX_BODY = 16 * 1024
BODY_S = 10.0  # for a body to arrive
_DEFAULT_PORTS = {"http": 80, "ws": 80, "https": 443, "wss": 443}
_METHODS = ("GET", "HEAD", "POST")
_JSON, FORM = "application/json", "application/x-www-form-urlencoded"
STOP_PATH = "/api/estop"  # takes a plain form as well, of a page that does not start
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; "
    "connect-src 'self'; worker-src 'self'; media-src 'self' blob:; manifest-src 'self'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'"
)
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
    this machine: therefore Host must be a known name, and Origin must be that host for each WebSocket and each POST.
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
        if self._is_known(scope, headers) and _is_own_origin(scope, headers):
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
        except asyncio.CancelledError:  # it still waited when the server ended
            with contextlib.suppress(RuntimeError):  # its answer has begun
                await _refuse(scope, receive, send, 503, "the server ends")

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """Status and text, if this request must not go on."""
        if not self._is_known(scope, headers):
            return 421, "this server has another name; start `pebble web` with --name for each name that it may have"
        if scope["method"] not in _METHODS:
            return 405, "use GET or POST"
        if scope["method"] == "POST":
            if not _is_own_origin(scope, headers):
                return 403, "this request comes from another site"
            if content_type(headers) not in ((_JSON, FORM) if scope["path"] == STOP_PATH else (_JSON,)):
                return 415, "send JSON as application/json"
        return None

    def _is_known(self, scope: Scope, headers: Headers) -> bool:
        hosts = headers.getlist("host")
        parsed = _split(hosts[0], _DEFAULT_PORTS[scope["scheme"]]) if len(hosts) == 1 else None
        if parsed is None:
            return False
        host, port = parsed
        own_address, own_port = scope.get("server") or ("", None)
        if f"{host}:{port}" in self._names:  # a name with its own port, as behind a forwarded one
            return True
        if port != own_port:
            return False
        wildcard = "*." + host.partition(".")[2]
        return host in self._names or wildcard in self._names or host == canonical(own_address)


def content_type(headers: Headers) -> str:
    """Return the kind of a request's body, without its parameters."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()


def host_names(settings: WebSettings) -> frozenset[str]:
    """The names by which browsers may address the server, besides the address at which a request arrives."""
    names: set[str] = {"127.0.0.1", "::1", "localhost", *settings.names}
    if not is_loopback(settings.host):
        names.add(settings.host)
        own = socket.gethostname()
        of_machine = (own, f"{own.partition('.')[0]}.local")
        names |= {*(of_machine if settings.certificate is None else certificates.show(settings.certificate).names)}
    return frozenset(map(canonical, names))


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def canonical(name: str) -> str:
    """One spelling of a host name or address; also of ``name:port``."""
    try:
        address = ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return name.lower().rstrip(".")
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)


def _split(host: str, default_port: int) -> tuple[str, int] | None:
    """Name and port of a Host header; None for what no browser sends."""
    name, colon, port = host.rpartition(":")
    if not colon or host.endswith("]"):
        name, port = host, str(default_port)
    if name.startswith("[") != name.endswith("]") or (":" in name and not name.startswith("[")):
        return None
    if not name or not port.isascii() or not port.isdigit() or len(port) > 5:
        return None
    return canonical(name), int(port)


def _is_own_origin(scope: Scope, headers: Headers) -> bool:
    """Origin is exactly the scheme and host of this request; a browser sends it with each WebSocket and each POST."""
    scheme = {"ws": "http", "wss": "https"}.get(scope["scheme"], scope["scheme"])
    return headers.getlist("origin") == [f"{scheme}://{headers.get('host', '')}".lower()]


async def _body(receive: Receive) -> bytes | None:
    """The whole body; None if it is too large."""
    body = bytearray()
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > MAX_BODY:
            return None
        if not message.get("more_body", False):
            return bytes(body)


def _replay(body: bytes, receive: Receive) -> Receive:
    """A ``receive`` that returns the body once, then what comes after it."""
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
    """Answer, and close the connection: what remains of the request is not read."""
    await PlainTextResponse(f"{text}\n", status, headers={"connection": "close"})(scope, receive, send)
