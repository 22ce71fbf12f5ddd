"""The operator page's web server: its limits for connections, and its run until a signal ends it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from pathlib import Path

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from pebble.errors import PebbleError, TransportError
from pebble.extensions.fleet import certificates
from pebble.extensions.page.app import create_app
from pebble.extensions.page.setting import WebSettings
from pebble.transports.credentials import no_password
from pebble.transports.renewed import Renewed
from pebble.transports.socket_holders import why_not

_LARGEST_MESSAGE = 64 * 1024
_END_S = 1
REQUEST_S = 10.0  # from a connection to its first whole request
UNREAD_S = 60.0  # in which a client reads something of what it is sent
PING_S, PONG_S = 2.0, 4.0  # between two pings on a WebSocket, and for the answer
_ACCEPT = 16  # connections at once; what the last ones have sent is read before the next ones come
_WAITING = 2048  # connections to be accepted
_ALL_ADDRESSES = ("0.0.0.0", "::")  # noqa: S104 - compared, not listened on


def run(settings: WebSettings, *, on_ready: Callable[[str], None] | None = None) -> int:
    """Serve until SIGINT or SIGTERM; ``on_ready`` gets the address once pages can open it. Raises PebbleError."""
    _raise_limit_of_descriptors()
    with listen(settings) as listener:
        asyncio.run(_serve(settings, listener, on_ready))
    return 0


async def _serve(settings: WebSettings, listener: socket.socket, on_ready: Callable[[str], None] | None) -> None:
    config = server_config(settings)
    config.load()
    if config.ssl is not None and settings.certificate is not None:
        renew_certificate(config.ssl, settings.certificate, settings.key)
    server = uvicorn.Server(config)
    starting = asyncio.ensure_future(_report_start(server, listener, url_of(settings, listener), on_ready))
    try:
        await server.serve(sockets=[listener])
    finally:
        starting.cancel()
    if not server.started:
        raise PebbleError("the operator page did not start: the lines above say why")


async def _report_start(
    server: uvicorn.Server, listener: socket.socket, url: str, on_ready: Callable[[str], None] | None
) -> None:
    """Call ``on_ready`` with the address once the server accepts connections."""
    while not server.started:
        await asyncio.sleep(0.02)
    # asyncio takes its backlog, _ACCEPT, for both: how many it accepts at once, and how many may wait for that.
    listener.listen(_WAITING)  # changes only how many may wait
    if on_ready is not None:
        on_ready(url)


def _server_context(certificate: Path, key: Path | None) -> ssl.SSLContext:
    """Return a TLS context for this certificate. Raises TransportError that names the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key, no_password)
    except OSError as error:  # ssl.SSLError is one
        raise TransportError(f"the certificate {certificate} cannot be used: {error}") from None
    return context


def renew_certificate(listening: ssl.SSLContext, certificate: Path, key: Path | None) -> None:
    """Let new connections at ``listening`` use the present content of the certificate's files."""
    files = [certificate] if key is None else [certificate, key]
    newest = Renewed(files, lambda: _server_context(certificate, key), listening)

    def choose(connection: ssl.SSLObject, _name: str | None, _context: ssl.SSLContext) -> None:
        connection.context = newest.get()

    listening.sni_callback = choose


class HttpProtocol(H11Protocol):
    """An HTTP connection that is closed if no request comes; uvicorn has no limit for that."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.loop.call_later(REQUEST_S, self._abort_unused)

    def _abort_unused(self) -> None:
        if self.scope is None and self in self.connections:
            self.transport.abort()


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """A WebSocket that is closed at once if a ping is not answered, without sending what waits.

    Otherwise a full connection would delay the end of control.
    """

    def keepalive_timeout(self) -> None:
        self.transport.abort()


def server_config(settings: WebSettings) -> uvicorn.Config:
    return uvicorn.Config(
        create_app(settings),
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # else any local program chooses the address by which logins are counted
        date_header=False,
        http=HttpProtocol,
        ws=WebSocketProtocol,
        ws_per_message_deflate=False,  # pictures are compressed already: it would double the time they take
        ws_max_size=_LARGEST_MESSAGE,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PONG_S,
        timeout_graceful_shutdown=_END_S,
        backlog=_ACCEPT,  # no limit_concurrency: strangers would use it up, and keep out a stop
    )


def listen(settings: WebSettings) -> socket.socket:
    """Return a socket that is bound to the page's address. Raises PebbleError."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # With IPPROTO_TCP, as asyncio sets TCP_NODELAY only on sockets that name it.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux: what is accepted has it, too
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * UNREAD_S))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise PebbleError(
            f"cannot listen on {settings.host} port {settings.port}: {why_not(error, settings.port)};"
            " choose another with --port"
        ) from None
    return listener


def url_of(settings: WebSettings, listener: socket.socket) -> str:
    """Return the address for a browser on this machine, or with the name by which others reach it."""
    host = settings.names[0] if settings.names else settings.host
    if host in _ALL_ADDRESSES:  # no browser can open these
        names = certificates.show(settings.certificate).names if settings.certificate else ()
        host = next((name for name in names if name not in _ALL_ADDRESSES), socket.gethostname())
    if host.count(":") > 1:  # an IPv6 address
        host = f"[{host}]:{listener.getsockname()[1]}"
    elif ":" not in host:  # a name may have its own port
        host = f"{host}:{listener.getsockname()[1]}"
    return f"{'https' if settings.certificate else 'http'}://{host}/"


def _raise_limit_of_descriptors() -> None:
    """Raise the limit of open files as far as the system allows.

    Otherwise many idle connections of strangers could prevent a stop from being received.
    """
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
