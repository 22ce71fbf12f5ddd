"""Runs the server of the operator page until a signal ends it."""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Callable
from pathlib import Path

import uvicorn

from pebble.client.page import WebSettings
from pebble.errors import PebbleError
from pebble.fleet import certificates
from pebble.transports.renewed import Renewed
from pebble.transports.socket_holders import why_not
from pebble.transports.tls import make_server_context
from pebble.web.access.connections import ACCEPT, HttpProtocol, Listener, Loop, WebSocketProtocol
from pebble.web.app import create_app

_LARGEST_MESSAGE = 64 * 1024
_END_S = 1
_ALL_ADDRESSES = ("0.0.0.0", "::")  # noqa: S104 - compared, not listened on


def run(settings: WebSettings, *, on_ready: Callable[[str], None] | None = None) -> int:
    """Serve until SIGINT or SIGTERM; ``on_ready`` gets the address once it can be opened. Raises PebbleError."""
    listener = listen(settings)
    try:
        with asyncio.Runner(loop_factory=Loop) as runner:
            runner.run(_serve(settings, listener, on_ready))
    finally:
        listener.close()
    return 0


async def _serve(settings: WebSettings, listener: Listener, on_ready: Callable[[str], None] | None) -> None:
    config = server_config(settings, listener)
    config.load()
    if config.ssl is not None and settings.certificate is not None:
        renew_certificate(config.ssl, settings.certificate, settings.key)
    server = uvicorn.Server(config)
    watching = asyncio.ensure_future(_report(server, url_of(settings, listener), on_ready))
    try:
        await server.serve(sockets=[listener])
    finally:
        watching.cancel()
    if not server.started:
        raise PebbleError("the operator page did not start: the lines above say why")


async def _report(server: uvicorn.Server, url: str, on_ready: Callable[[str], None] | None) -> None:
    while not server.started:
        await asyncio.sleep(0.02)
    if on_ready is not None:
        on_ready(url)


def renew_certificate(listening: ssl.SSLContext, certificate: Path, key: Path | None) -> None:
    """Have each new connection to ``listening`` use the certificate that the files hold then."""
    files = [certificate] if key is None else [certificate, key]
    newest = Renewed(files, lambda: make_server_context(certificate, key), listening)

    def choose(connection: ssl.SSLObject, _name: str | None, _context: ssl.SSLContext) -> None:
        connection.context = newest.get()

    listening.sni_callback = choose


def server_config(settings: WebSettings, listener: Listener) -> uvicorn.Config:
    app = create_app(settings)
    app.state.recognise = listener.recognise
    return uvicorn.Config(
        app,
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
        ws_ping_interval=2.0,
        ws_ping_timeout=4.0,
        timeout_graceful_shutdown=_END_S,
        backlog=ACCEPT,  # no limit_concurrency: the listener limits connections
    )


def listen(settings: WebSettings) -> Listener:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = Listener(family)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise PebbleError(
            f"cannot listen on {settings.host} port {settings.port}: {why_not(error, settings.port)};"
            " choose another with --port"
        ) from None
    return listener


def url_of(settings: WebSettings, listener: socket.socket) -> str:
    """The address that a browser on this machine opens, or the name by which others reach it."""
    host = settings.names[0] if settings.names else settings.host
    if host in _ALL_ADDRESSES:  # no browser can open these
        names = certificates.show(settings.certificate).names if settings.certificate else ()
        host = next((name for name in names if name not in _ALL_ADDRESSES), socket.gethostname())
    shown = f"[{host}]" if host.count(":") > 1 else host
    port = "" if ":" in host and shown == host else f":{listener.getsockname()[1]}"  # a name may have its own port
    return f"{'https' if settings.certificate else 'http'}://{shown}{port}/"
