"""The connections of a gateway, and which changes of theirs count."""

import threading
from collections.abc import Callable, Iterator

from pebble.transports import State, Transport


class Connections:
    """``broker`` carries robots, ``presence`` the heartbeats; only with both does the gateway know its place.

    ``stops`` has nothing but stops, so that nothing holds them up.
    """

    def __init__(self, hub: Transport, broker: Transport, presence: Transport, stops: Transport) -> None:
        self.hub, self.broker, self.presence, self.stops = hub, broker, presence, stops
        self._looking = threading.Lock()
        self._at_broker = self._at_hub = False

    def __iter__(self) -> Iterator[Transport]:
        return iter((self.hub, self.stops, self.presence, self.broker))

    @property
    def at_hub(self) -> bool:
        return self.hub.state is State.CONNECTED

    def look(self, on_broker: Callable[[bool], None], on_hub: Callable[[], None]) -> None:
        """Call what has changed since the last look: one carries, the other shows whether the others hear this one."""
        with self._looking:
            at_broker = all(one.state is State.CONNECTED for one in (self.broker, self.presence))
            if at_broker is not self._at_broker:
                self._at_broker = at_broker
                on_broker(at_broker)
            if self.at_hub is not self._at_hub:
                self._at_hub = not self._at_hub
                on_hub()
