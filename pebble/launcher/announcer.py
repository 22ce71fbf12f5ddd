"""The process that publishes the launcher's messages: ``python -m pebble.launcher.announcer CONFIG``.

The launcher itself never opens a transport: with its threads it could not fork, and it might wait for a broker. On a
Zenoh robot this process is also the hub, which keeps running when publishing fails.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING

from pebble.config import Config, config_of_process
from pebble.errors import PebbleError
from pebble.launcher.announcer_pipe import next_message
from pebble.launcher.reactor import Reactor
from pebble.runtime.connections import hub_settings, local_transport
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier, set_log_level, set_up_logging
from pebble.runtime.process import exit_at_the_latest
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message, Transport
from pebble.transports.wakeup import WakeupPipe

if TYPE_CHECKING:
    from pebble.transports.zenoh.hub import ZenohHub

_STDIN = 0
_NO_HUB = nullcontext()

log = logging.getLogger(__name__)


class Announcer:
    """A publisher of the messages on ``pipe``. States are retained: the transport sends them again where it must."""

    def __init__(self, pipe: int, transport: Transport, stops_of: Config | None = None) -> None:
        """Store the arguments; ``stops_of``: a robot without a bridge, which would repeat the stops."""
        self._pipe, self._transport, self._stops_of = pipe, transport, stops_of
        self._reactor = Reactor()
        self._wake = WakeupPipe()
        self._stopping = False
        self._log = RateLimitedLog(log)  # a hub publishes its own lines, too: each failure could cause another
        os.set_blocking(pipe, False)

    def run(self, notify: Notifier, hub: ZenohHub | None = None) -> None:
        """Run until :meth:`stop` or the end of the pipe; then publish what is left in the pipe, and the will."""
        self._reactor.watch(self._pipe, self._receive)
        self._reactor.watch(self._wake.fileno(), self._wake.clear)
        self._reactor.every(ALIVE_PERIOD_S, notify.alive)
        if hub is not None:
            self._reactor.every(ALIVE_PERIOD_S, hub.look)
        notify.ready()
        try:
            self._transport.open(timeout=0.0)
            if self._stops_of is not None:
                from pebble.launcher.repeated_stops import repeat_stops  # only who needs it pays for it

                repeat_stops(self._stops_of, self._transport, self._reactor)
            self._reactor.run_until(lambda: self._stopping)
            with suppress(BlockingIOError):
                while (message := next_message(self._pipe)) is not None:
                    self._publish(message)
        finally:
            self._transport.close()

    def stop(self) -> None:
        """End :meth:`run` soon. Safe from signal handlers."""
        self._stopping = True
        self._wake.set()

    def _receive(self) -> None:
        message = next_message(self._pipe)
        if message is None:
            self._stopping = True
        else:
            self._publish(message)

    def _publish(self, message: Message) -> None:
        try:
            self._transport.publish(message.topic, message.payload, qos=message.qos, retain=message.retain)
        except Exception:  # noqa: BLE001 - no message may end the hub
            self._log.exception(message.topic, "could not publish on %s", message.topic)


def run(
    make_transport: Callable[[Message], Transport],
    hub: AbstractContextManager[ZenohHub | None] = _NO_HUB,
    stops_of: Config | None = None,
) -> int:
    """Publish the messages on stdin through ``make_transport(will)``, beside the hub; return the exit code."""
    try:
        will = next_message(_STDIN)
        if will is None:  # the launcher has ended already
            return 0
        announcer = Announcer(_STDIN, make_transport(will), stops_of)
    except PebbleError as error:
        log.error("the launcher publishes nothing: %s", error)
        return 1

    def stop(_signal: int, _frame: object) -> None:
        exit_at_the_latest()
        announcer.stop()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    try:
        with hub as open_hub:
            announcer.run(Notifier(), open_hub)
    except PebbleError as error:
        log.error("%s", error)
        return 1
    return 0


def main(arguments: list[str]) -> int:
    """Run the announcer of the robot with this config; return the exit code."""
    set_up_logging("INFO")
    if len(arguments) != 1:
        log.error("usage: python -m pebble.launcher.announcer CONFIG, with messages from the launcher on stdin")
        return 2
    try:
        config = config_of_process(arguments[0])
    except PebbleError as error:
        log.error("%s", error)
        return 1
    set_log_level(config.log_level)
    stops_of = config if config.motor_owners and not config.services.mqtt_bridge.enabled else None
    return run(lambda will: local_transport(config, "launcher", will=will), _hub(config), stops_of)


def _hub(config: Config) -> AbstractContextManager[ZenohHub | None]:
    """Return the hub of a Zenoh robot, not yet open; no hub for other robots."""
    if config.transport.kind != "zenoh":
        return _NO_HUB
    from pebble.runtime.hub import open_hub  # only who needs it pays for it

    return open_hub(hub_settings(config))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
