"""The HTTP server that Prometheus scrapes, with its connection to the robots' broker."""

import asyncio
import hmac
import time
from collections.abc import Callable
from typing import Final

from pebble.errors import PebbleError
from pebble.extensions.metrics.robots import Robots, Samples
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.robot_topics import FLEET, SYNONYMS
from pebble.extensions.operator.notices import say
from pebble.extensions.operator.signals import ending_event
from pebble.transports import Message, MqttSettings
from pebble.transports.counters import bounds_reached
from pebble.transports.socket_holders import why_not

REQUEST_S: Final = 5.0  # for a request and its answer
_MAX_REQUEST: Final = 8192  # bytes


class Exporter:
    """An HTTP server with the robots of one broker. Everything runs on the event loop."""

    def __init__(self, settings: MqttSettings, token: str) -> None:
        self._robots, self._broker = Robots(), Broker(settings, "pebble-exporter")
        self._authorization = f"Bearer {token}".encode() if token else b""

    async def serve(self, host: str, port: int, on_ready: Callable[[str], None]) -> None:
        """Serve until a signal ends it, and wait for the broker while it is away. Raises PebbleError."""
        with ending_event() as ended:
            try:
                server = await asyncio.start_server(self._answer, host, port, limit=_MAX_REQUEST)
            except OSError as error:
                why = why_not(error, port)
                raise PebbleError(f"cannot listen on {host} port {port}: {why}; choose another with --port") from None
            await self._broker.open()
            self._broker.report(say)
            try:
                for channel in (*FLEET, *SYNONYMS):
                    await self._broker.subscribe(channel.filter("+/+/+"), self._receive)
                name = f"[{host}]" if ":" in host else host
                on_ready(f"http://{name}:{server.sockets[0].getsockname()[1]}/metrics")
                await ended.wait()
            finally:
                server.close()
                await self._broker.close()

    def _receive(self, message: Message, at: float) -> None:
        self._robots.receive(message, at, time.time() - (time.monotonic() - at))

    def scrape(self) -> str:
        """Return all metrics; those of robots only while the broker is connected."""
        now, samples = time.monotonic(), Samples()
        if self._broker.connected:
            self._robots.add_to(samples, now)
        dropped = {"queue": self._broker.dropped, **bounds_reached(self._broker.transport.counters)}
        for reason, count in dropped.items():
            samples.add("pebble_dropped_total", count, reason=reason)
        samples.add("pebble_exporter_broker_connected", self._broker.connected)
        samples.add("pebble_exporter_scrape_seconds", time.monotonic() - now)
        return samples.text()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(REQUEST_S):
                status, text = self._response(await reader.readuntil(b"\r\n\r\n"))
                head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4\r\nConnection: close\r\n\r\n"
                writer.write((head + text).encode())
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            writer.transport.abort()

    def _response(self, request: bytes) -> tuple[str, str]:
        """Return the status and the text that answer a request's head."""
        line, *headers = request.split(b"\r\n")
        authorization = b""
        for header in headers:
            name, _, value = header.partition(b":")
            if name.lower() == b"authorization":
                authorization = value.strip()
        if self._authorization and not hmac.compare_digest(authorization, self._authorization):
            return "401 Unauthorized", "the token is missing, or is another one\n"
        if line.split(b" ")[:2] != [b"GET", b"/metrics"]:
            return "404 Not Found", "only GET /metrics is here\n"
        return "200 OK", self.scrape()


def run(settings: MqttSettings, host: str, port: int, token: str, on_ready: Callable[[str], None]) -> None:
    """Serve until SIGINT, SIGTERM or SIGHUP; ``on_ready`` gets the address. Raises PebbleError."""
    asyncio.run(Exporter(settings, token).serve(host, port, on_ready))
