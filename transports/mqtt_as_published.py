"""What an as-published connection must remember, because there kept and live messages look alike (T7). Pure."""

from __future__ import annotations

from pebble.transports.base import Message
from pebble.transports.mqtt_filters import overlap

_LIMIT = 65_536  # topics whose newest kept payload is remembered, per connection


class AsPublished:
    """Tells own kept copies, and copies that come a second time, from news. Ask it about messages with retain set."""

    def __init__(self) -> None:
        self._said: dict[str, bytes] = {}  # our newest payload of a topic, while nobody else has said another
        self._seen: dict[str, bytes] = {}  # the newest payload received, by topic
        self._repeats: set[str] = set()  # topics whose kept copy is due a second time

    def begin(self) -> None:
        """A new connection: every kept copy is news again, except our own."""
        self._seen.clear()
        self._repeats.clear()

    def say(self, message: Message) -> None:
        self._said[message.topic] = message.payload

    def subscribe_again(self, filter_: str) -> None:
        """The broker is about to send the kept copies that ``filter_`` matches once more."""
        self._repeats.update(topic for topic in list(self._seen) if overlap(topic, filter_))

    def is_echo(self, message: Message) -> bool:
        """Our own kept copy, come back because we subscribed?"""
        if self._said.get(message.topic) == message.payload:
            return True
        self._said.pop(message.topic, None)  # somebody else had the last word
        return False

    def is_repeat(self, message: Message) -> bool:
        """The kept copy that `subscribe_again` made the broker send?"""
        seen = self._seen.pop(message.topic, None)
        if len(self._seen) >= _LIMIT:
            self._seen.pop(next(iter(self._seen)))
        self._seen[message.topic] = message.payload
        if seen != message.payload or message.topic not in self._repeats:
            return False
        self._repeats.discard(message.topic)
        return True
