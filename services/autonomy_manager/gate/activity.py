"""When the scripts of one run last published or received something. Pure; any thread may read it."""

import time
from collections.abc import Callable

SILENT_S = 10.0  # without a message a script is no longer shown as running, if it is known to wait


class Activity:
    """The gate notes what passes; a script's drive commands count, also while a person drives."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last = clock()
        self._active = self._connected = self._subscribed = False

    def message(self) -> None:
        """One passes, in whichever direction."""
        self._active, self._last = True, self._clock()

    def client(self, *, subscribed: bool) -> None:
        """A client is connected; ``subscribed``: it asks for messages."""
        self._connected, self._subscribed = True, self._subscribed or subscribed

    @property
    def silent(self) -> bool:
        """Whether nothing has passed for 10 s."""
        return self._clock() - self._last > SILENT_S

    @property
    def waits_for(self) -> str:
        """What a silent script waits for; empty: for nothing that is known, as one that acts once a minute."""
        if not self.silent:
            return ""
        if not self._connected:
            return "its own start: it has not connected to the broker"
        if self._subscribed:
            return "the messages that it subscribed to"
        return "" if self._active else "something: it has neither published nor subscribed"
