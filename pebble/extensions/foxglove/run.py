"""The program that serves robots to Foxglove until a signal ends it."""

import asyncio
import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from pebble.errors import TransportError
from pebble.extensions.foxglove.robots import Robots, filters
from pebble.extensions.foxglove.server import Server
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.signals import ending_event
from pebble.extensions.recordings.exports.foxglove_messages import Schemas
from pebble.transports import MqttSettings

_WITHDRAW_S, _CLOSE_S = 1.0, 0.5


class Settings(NamedTuple):
    """The program's settings. ``base``: the robot to show, or ``+/+/+``; ``where``: the broker in words."""

    broker: MqttSettings
    where: str
    base: str
    host: str
    port: int


class Summary(NamedTuple):
    """The figures in the program's last line."""

    robots: int
    published: int
    dropped: int
    refused: int


def run(settings: Settings, on_ready: Callable[[str], None]) -> Summary:
    """Serve until SIGINT, SIGTERM or SIGHUP; ``on_ready`` gets the address. Raises PebbleError."""
    return asyncio.run(serve(settings, on_ready, ending_event()))


async def serve(
    settings: Settings, on_ready: Callable[[str], None], ending: AbstractContextManager[asyncio.Event]
) -> Summary:
    """Serve until the event of ``ending`` is set; ``on_ready`` gets the address. Raises PebbleError."""
    loop, broker, schemas = asyncio.get_running_loop(), Broker(settings.broker, "pebble-foxglove"), Schemas()
    server = Server("Pebble", lambda topic, subscribed: _wake(loop, robots, topic, subscribed))
    robots = Robots(broker, server, schemas)
    address = server.start(settings.host, settings.port)

    def report_connection() -> None:
        if not broker.connected:
            server.report(f"{settings.where}: {broker.problem}")

    broker.on_state(report_connection)
    work = asyncio.create_task(_show(settings, broker, robots, lambda: on_ready(address)))
    try:
        with ending as ended:
            await asyncio.wait({work, asyncio.create_task(ended.wait())}, return_when=asyncio.FIRST_COMPLETED)
        if work.done():
            work.result()
    finally:
        work.cancel()
        server.stop()
        await robots.close(_WITHDRAW_S)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSE_S):
                await broker.close()
    dropped = server.dropped + robots.dropped + broker.dropped
    return Summary(len(robots.robots), server.published, dropped, robots.refused)


async def _show(settings: Settings, broker: Broker, robots: Robots, on_ready: Callable[[], None]) -> None:
    """Show the robots until the task is cancelled. Raises TransportError if there is no broker."""
    await broker.open()
    if not broker.connected:
        raise TransportError(f"cannot connect to {settings.where}: {broker.problem}")
    for filter_ in filters(settings.base):
        await broker.subscribe(filter_, robots.receive)
    on_ready()
    await asyncio.Event().wait()


def _wake(loop: asyncio.AbstractEventLoop, robots: Robots, topic: str, subscribed: bool) -> None:
    """Call ``robots.wake`` on the event loop's thread; do nothing if the loop has ended."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(lambda: robots.wake(topic, subscribed=subscribed))
