"""Serves the gate's clients on a loopback socket, all on one thread."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable

from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.autonomy_manager.gate.activity import Activity
from pebble.services.autonomy_manager.gate.client_filter import ClientFilter, Output
from pebble.services.autonomy_manager.gate.drive_outlet import DriveOutlet
from pebble.services.autonomy_manager.gate.relay import CHUNK, Broker, Relay

MAX_CONNECTIONS = 16


class GateServer:
    """Call :meth:`serve` on a thread of its own; :meth:`post` and :meth:`stop` from any thread."""

    def __init__(
        self,
        listener: socket.socket,
        broker: Callable[[], Broker],
        outlet: DriveOutlet,
        make_filter: Callable[[], ClientFilter],
        activity: Activity,
    ) -> None:
        self._listener, self._broker, self._outlet, self._make_filter = listener, broker, outlet, make_filter
        self._activity = activity
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._log = RateLimitedLog(logging.getLogger(__name__))

    # -- from any thread

    def post(self, job: Callable[[], None]) -> None:
        """Run ``job`` on the server's thread; not after it has ended."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(job)

    def stop(self) -> None:
        """Close all connections; then :meth:`serve` returns."""
        self.post(self._stopped.set)

    def serve(self) -> None:
        """Serve until :meth:`stop`."""
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    # -- the server's thread

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._accept, sock=self._listener, limit=CHUNK)
        async with server:
            await self._stopped.wait()
        for client in self._clients:
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= MAX_CONNECTIONS:
            self._log.warning("connections", "a script has more than %d connections: refused one", MAX_CONNECTIONS)
            writer.transport.abort()
            return
        relay = Relay((reader, writer), self._make_filter(), self._handle, self._ended, self._activity)
        client = self._loop.create_task(relay.run(self._broker()))
        self._clients.add(client)
        client.add_done_callback(self._clients.discard)

    def _handle(self, output: Output, relay: Relay) -> None:
        if output.upstream or output.published:
            self._activity.client(subscribed=output.subscribed)
        if output.published:
            self._activity.message()
        for topic in output.refused_topics:
            self._log.warning("topic", "a script may not publish on %.200r: refused", topic)
        for command in output.drive:
            self._outlet.receive(command, relay, self._loop.time())
        if output.refusal is not None:
            self._log.warning("client", "closed the connection of a script: %s", output.refusal)
        self._set_timer()

    def _ended(self, relay: Relay) -> None:
        self._outlet.ended(relay, self._loop.time())
        self._set_timer()

    def _set_timer(self) -> None:
        due = self._outlet.due
        if due is not None and self._timer is None:
            self._timer = self._loop.call_at(due, self._publish_due)

    def _publish_due(self) -> None:
        self._timer = None
        self._outlet.publish_due(self._loop.time())
        self._set_timer()
