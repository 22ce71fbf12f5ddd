"""Decides when the drive commands of a run are published: at most 50 a second, but a zero at once. Pure."""

from typing import NamedTuple

PERIOD_S = 0.02  # between two commands, unless the second one stops what moves


class Taken(NamedTuple):
    """A command whose turn it is."""

    topic: str
    payload: bytes
    moves: bool


class Pacer:
    """The newest command waits for its turn. A zero never waits, and what waited before it is dropped.

    Only a zero that repeats the last published one waits: else a script could flood the motor owner with them.
    Times are seconds on one clock of the caller. ``topic`` is one of a few: a robot has a drive topic per motor owner.
    """

    def __init__(self) -> None:
        self.overwritten = 0  # commands that a newer one replaced before their turn
        self._free_at = float("-inf")
        self._waiting: dict[str, Taken] = {}
        self._still: set[str] = set()  # topics on which a zero was the last one

    @property
    def due(self) -> float | None:
        """When :meth:`take` has a command; None if none waits."""
        return self._free_at if self._waiting else None

    def offer(self, topic: str, payload: bytes, moves: bool, now: float) -> bool:
        """True: publish this command now. False: it waits, or is replaced by a newer one."""
        if self._waiting.pop(topic, None) is not None:
            self.overwritten += 1
        if now < self._free_at and (moves or topic in self._still):
            self._waiting[topic] = Taken(topic, payload, moves)
            return False
        self._note(topic, moves)
        self._free_at = max(self._free_at, now + PERIOD_S)
        return True

    def take(self, now: float) -> Taken | None:
        """A waiting command whose turn it is; ask again until there is none."""
        if not self._waiting or now < self._free_at:
            return None
        taken = self._waiting.pop(next(iter(self._waiting)))
        self._free_at = now + PERIOD_S
        self._note(taken.topic, taken.moves)
        return taken

    def discard(self) -> None:
        """Drop what waits."""
        self.overwritten += len(self._waiting)
        self._waiting.clear()

    def _note(self, topic: str, moves: bool) -> None:
        (self._still.discard if moves else self._still.add)(topic)
