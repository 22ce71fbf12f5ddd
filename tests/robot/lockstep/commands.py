"""Which commands that move anything exist: each has speeds of its own, so the MCU's line says whose it is."""

from __future__ import annotations

from itertools import count


class Commands:
    """Senders of commands by the speeds of the wheels, in thousandths."""

    def __init__(self) -> None:
        self._numbers = count()
        self._senders: dict[tuple[int, int], str] = {}
        self.grouped: set[tuple[int, int]] = set()  # those that were sent with lights

    def add(self, sender: str) -> tuple[float, float]:
        """Return ``x`` and ``z`` of a new command."""
        number = next(self._numbers)
        left, right = 300 + number % 697, 300 + number // 697  # 697 is a prime: neighbours differ
        self._senders[left, right] = sender
        return (left - right) / 2000, (left + right) / 2000

    def sender_of(self, speeds: tuple[int, int]) -> str:
        return self._senders[speeds]
