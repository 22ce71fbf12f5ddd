"""Which commands that move anything exist: each has speeds of its own, so the MCU's line says whose it is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

PERSON = 0


@dataclass(slots=True)
class Command:
    """One command that moves the robot. ``run``: of its script; PERSON."""

    run: int
    sender: str
    published: float
    valid_s: float
    may_move: bool  # False: a retained or a malformed one
    arrived: float = -1.0  # at the motor owner, the newest time
    order: int = -1  # of that arrival
    judged: float = -1.0


class Commands:
    """Commands by the speeds of the wheels, in thousandths."""

    def __init__(self) -> None:
        self._numbers = count()
        self._commands: dict[tuple[int, int], Command] = {}
        self.grouped: set[tuple[int, int]] = set()  # those that were sent with lights

    def add(self, command: Command) -> tuple[float, float]:
        """Return ``x`` and ``z`` of a new command."""
        number = next(self._numbers)
        left, right = 300 + number % 697, 300 + number // 697  # 697 is a prime: neighbours differ
        self._commands[left, right] = command
        return (left - right) / 2000, (left + right) / 2000

    def find(self, x: float, z: float) -> Command | None:
        return self._commands.get((round(1000 * (z + x)), round(1000 * (z - x))))

    def of(self, speeds: tuple[int, int]) -> Command | None:
        return self._commands.get(speeds)
