"""The unacknowledged messages of a connection, which show how fast it is. Pure: times are passed in."""

from collections import deque
from typing import NamedTuple


class Sent(NamedTuple):
    size: int  # bytes on the wire
    at: float  # seconds


class InFlight:
    """The unacknowledged messages of one connection, oldest first; ``limit``: the most that are remembered.

    TCP acknowledges bytes in order. So if n bytes are unacknowledged, they are the last n that were sent, and each
    message that was sent before them is acknowledged. ``slack``: so many unacknowledged bytes may be pings and headers.
    """

    def __init__(self, slack: int, limit: int | None = None) -> None:
        self._slack = slack
        self._messages: deque[Sent] = deque(maxlen=limit)

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def oldest(self) -> Sent | None:
        return self._messages[0] if self._messages else None

    def sent(self, size: int, now: float) -> None:
        self._messages.append(Sent(size, now))

    def acknowledge(self, waiting: int) -> list[Sent]:
        """Remove and return the messages that are acknowledged if ``waiting`` bytes are still unacknowledged."""
        acknowledged = []
        newer = sum(message.size for message in self._messages)
        while self._messages:
            newer -= self._messages[0].size
            if waiting > newer + self._slack:
                break
            acknowledged.append(self._messages.popleft())
        return acknowledged

    def age_s(self, now: float) -> float:
        """Return the seconds since the oldest unacknowledged message was sent; 0 if there is none."""
        return now - self._messages[0].at if self._messages else 0.0

    def clear(self) -> None:
        """Forget all messages, which are lost with the connection."""
        self._messages.clear()
