"""How old the oldest packet is that the other machine has not confirmed. Pure: times and bytes are passed in."""

from __future__ import annotations

from collections import deque

_OVERHEAD = 60  # bytes of a topic, headers and pings that a packet may add to what waits
_LIMIT = 256  # packets remembered; far more than may wait


class UnderWay:
    """Packets that one connection accepted, oldest first; it confirms bytes in order."""

    def __init__(self) -> None:
        self._packets: deque[tuple[int, float]] = deque(maxlen=_LIMIT)  # size, when it was sent

    def sent(self, size: int, now: float) -> None:
        self._packets.append((size + _OVERHEAD, now))

    def clear(self) -> None:
        """The connection is gone, with all that waited in it."""
        self._packets.clear()

    def age_s(self, waiting: int, now: float) -> float:
        """Seconds since the oldest unconfirmed packet was sent, ``waiting`` bytes being unconfirmed; 0 without one."""
        newer = sum(size for size, _ in self._packets)
        while self._packets:
            size, sent_at = self._packets[0]
            newer -= size
            if waiting > newer + _OVERHEAD:
                return now - sent_at
            self._packets.popleft()
        return 0.0
