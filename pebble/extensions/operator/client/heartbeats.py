"""A connection that receives only heartbeats, so that robots are found whatever else the broker delivers or loses."""

import os
import threading
from collections import deque
from dataclasses import replace

from pebble.contract import ONLINE
from pebble.extensions.operator.client.connection import OPEN_TIMEOUT_S, wait_for
from pebble.extensions.operator.client.robot_topics import SYNONYMS
from pebble.transports import Message, MqttSettings, State, Transport, create

_FILTERS = [channel.filter("+/+/+") for channel in (ONLINE, *SYNONYMS)]
_WAITING = 10_000  # heartbeats, of which the oldest goes: it comes again


class Heartbeats:
    """A connection subscribed only to heartbeats: with MQTT 5 to live ones, otherwise also to retained ones.

    It is made on another thread, and no caller waits for it.
    """

    def __init__(self, settings: MqttSettings) -> None:
        self._settings = replace(settings, max_qos=0)
        self._heard: deque[Message] = deque(maxlen=_WAITING)
        self._transport: Transport | None = None
        self._closed = threading.Event()
        threading.Thread(target=self._open, name="pebble-heartbeats", daemon=True).start()

    def take(self) -> list[Message]:
        """Return the heartbeats that arrived since the last call."""
        return [self._heard.popleft() for _ in range(len(self._heard))]

    def close(self) -> None:
        """Close the connection; it may take a second."""
        self._closed.set()
        if self._transport is not None:
            self._transport.close()

    def _open(self) -> None:
        """Connect with MQTT 5 or, if the broker refuses that, as configured; then subscribe."""
        for settings in (replace(self._settings, protocol="5", sends_retained=False), self._settings):
            transport = self._transport = create("mqtt", f"pebble-heartbeats-{os.getpid()}", settings)
            transport.open(0.0)
            wait_for(lambda: transport.state is not State.CONNECTING or transport.problem, OPEN_TIMEOUT_S)  # noqa: B023
            if self._closed.is_set():
                transport.close()
                return
            if transport.state is State.CONNECTED or settings is self._settings:
                transport.subscribe_all(dict.fromkeys(_FILTERS, self._heard.append), direct=True)
                return
            transport.close()
