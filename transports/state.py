"""The state of a transport's connection, and the watchers of its changes."""

import logging
import threading
from collections.abc import Callable
from enum import Enum

log = logging.getLogger(__name__)


class State(Enum):
    CLOSED = "closed"
    CONNECTING = "connecting"
    CONNECTED = "connected"


Watcher = Callable[[State], None]


class StateChanges:
    """A notifier: it tells watchers each change of a transport's state, in order. Any thread may use it."""

    def __init__(self, client_id: str) -> None:
        self.lock = threading.RLock()  # held while the state changes and its watchers are called
        self._client_id = client_id
        self.connected = threading.Event()
        self.watchers: list[Watcher] = []

    def notify(self, state: State) -> None:
        """Tell the watchers the new state. Call it with :attr:`lock` held."""
        if state is State.CONNECTED:
            self.connected.set()
        else:
            self.connected.clear()
        for watcher in list(self.watchers):
            try:
                watcher(state)
            except Exception:  # foreign code on our thread
                log.exception("a state watcher of %s failed", self._client_id)
