"""The unacknowledged messages of a connection, which show how fast it is. Pure: times are passed in."""

from collections import deque
from typing import NamedTuple


class Sent(NamedTuple):
    size: int  # bytes on the wire
    at: float  # seconds


class InFlight:
    """The unacknowledged messages of one connection, oldest first; ``limit``: the most that are remembered.

    TCP acknowledges bytes in order, so the unacknowledged bytes belong to the newest messages: up to its size to the
    newest, then to the one before it, and so on. A message for which no bytes are left is acknowledged. ``slack`` bytes
    of pings and headers may be unacknowledged although the message before them is not.
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
        """Remove and return the messages that are acknowledged when ``waiting`` bytes are not."""
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
        """Forget all messages: the connection is lost, and they with it."""
        self._messages.clear()
