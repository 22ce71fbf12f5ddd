"""Where a replay is in its recording: the state to be sent first, and the next message."""

from __future__ import annotations

from collections.abc import Iterator

from pebble.recordings.files.mcap import Recorded
from pebble.recordings.replay.rules import Rules
from pebble.recordings.replay.source import ReplaySource


class Reading:
    """Only what is published; ``skipped`` counts the messages between."""

    def __init__(self, source: ReplaySource, rules: Rules, until_ns: int) -> None:
        self.next: Recorded | None = None
        self.state: list[Recorded] = []  # to be sent before the next message, the last one first
        self.skipped = 0
        self._source, self._rules, self._until_ns = source, rules, until_ns
        self._messages: Iterator[Recorded] = iter(())

    def open(self, since_ns: int) -> None:
        """Go on from another time, with the state and the pictures that a decoder needs by then."""
        self._messages = self._source.messages(since_ns, self._until_ns)
        self.state = self._source.state_before(since_ns, self._rules.publishes)[::-1] if since_ns else []
        self.advance()

    def advance(self) -> None:
        """Find the next message that is published; those between take no time."""
        for message in self._messages:
            if self._rules.publishes(message.channel):
                self.next = message
                return
            self.skipped += 1
        self.next = None
