"""Publishes recorded messages again, and a zero after those that move something. Pure: publishing is passed in."""

from __future__ import annotations

from collections.abc import Callable

from pebble.recordings.files.mcap import Recorded
from pebble.recordings.replay.rules import Rules, zero
from pebble.transports import Message


class Output:
    """``publish`` returns False for what it cannot take now; ``wall_ns`` is the time since 1970."""

    def __init__(self, rules: Rules, publish: Callable[[Message], bool], wall_ns: Callable[[], int]) -> None:
        self.sent = self.skipped = 0
        self._rules, self._publish, self._wall_ns = rules, publish, wall_ns
        self._moved: dict[str, None] = {}  # topics of drive commands without a zero after them

    @property
    def moves(self) -> bool:
        """Whether something may be moving because of what was published."""
        return bool(self._moved)

    def send(self, message: Recorded, position_ns: int) -> bool:
        """Whether it is done; a stamp was ``position_ns`` - stamp old then, and is as old now."""
        found = self._rules.outgoing(message, self._wall_ns() - position_ns)
        if found is None:
            self.skipped += 1
            return True
        if not self._publish(found.message):
            return False
        self.sent += 1
        if found.moves is not None:
            self._moved.pop(found.message.topic, None)
            if found.moves:
                self._moved[found.message.topic] = None
        return True

    def halt(self) -> None:
        """A zero after each drive command that moves. Without a connection the robot's own deadline has to do."""
        self._moved = {topic: None for topic in self._moved if not self._publish(zero(topic))}
