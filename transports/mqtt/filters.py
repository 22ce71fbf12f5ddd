"""The filters of one MQTT connection: those subscribed to at the broker (T11), and the filter for own messages (T7).

Pure. A broker may send a message once per matching filter. Measured on mosquitto 2.0.11: MQTT 5 always does, 3.1.1
never, and bridge mode does for retained messages only. Overlapping filters are therefore merged into one that covers
them; the messages that it matches in excess are sorted out by exact matching on arrival.
"""

import threading
from collections.abc import Iterator, Sequence
from hashlib import blake2b

from pebble.transports.base import Message
from pebble.transports.bounds import BoundedTable
from pebble.transports.topics import beginning, is_pattern

_LIMIT = 65_536  # topics whose newest retained payload is recognised, per connection
_BYTES = 8 << 20  # the same, for their names and digests


def overlap(first: str, second: str) -> bool:
    """True if there is a topic that both filters match."""
    begin, other_begin = beginning(first), beginning(second)
    if not (begin.startswith(other_begin) or other_begin.startswith(begin)):
        return False  # the fast way, for most pairs of filters
    first_levels, second_levels = first.split("/"), second.split("/")
    if "$" in (first_levels[0][:1], second_levels[0][:1]) and first_levels[0] != second_levels[0]:
        return False  # a first level with a $ is matched by the same text alone, not by a wildcard
    for first_level, second_level in zip(first_levels, second_levels, strict=False):
        if first_level == "#" or second_level == "#":
            return True
        if first_level != second_level and "+" not in (first_level, second_level):
            return False
    if len(first_levels) == len(second_levels):
        return True
    longer, compared = max(first_levels, second_levels, key=len), min(len(first_levels), len(second_levels))
    return longer[compared] == "#"  # a/# matches a as well


def cover(first: str, second: str) -> str:
    """Return a filter that matches everything that either of two overlapping filters matches, level by level."""
    first_levels, second_levels = first.split("/"), second.split("/")
    levels: list[str] = []
    for first_level, second_level in zip(first_levels, second_levels, strict=False):
        if first_level == "#" or second_level == "#":
            return "/".join([*levels, "#"])
        levels.append(first_level if first_level == second_level else "+")
    return "/".join(levels if len(first_levels) == len(second_levels) else [*levels, "#"])  # a/# matches a, too


class BrokerFilters:
    """The filters that a client has subscribed to at its broker; no two of them overlap."""

    def __init__(self) -> None:
        self.lock = threading.RLock()  # to be held: it guards the filters, and their connection
        self._subscribed: list[str] = []

    def __iter__(self) -> Iterator[str]:
        return iter(list(self._subscribed))

    def add(self, wanted: str) -> tuple[str, list[str]]:
        """Add ``wanted``; return the filter to subscribe to, and the filters that it replaces.

        The filter may be subscribed to already: subscribing again gets retained messages.
        """
        merged: set[str] = set()
        while True:
            overlapping = [
                existing for existing in self._subscribed if existing not in merged and overlap(existing, wanted)
            ]
            if not overlapping:
                break
            for existing in overlapping:
                wanted = cover(wanted, existing)  # wider: it may overlap more of them
                merged.add(existing)
        self._subscribed = [*(existing for existing in self._subscribed if existing not in merged), wanted]
        return wanted, sorted(merged - {wanted})

    def prune(self, unwanted: str, wanted: Sequence[str]) -> list[str]:
        """Remove and return the subscribed filters that overlap ``unwanted``, but overlap no filter in ``wanted``."""
        idle = [
            existing
            for existing in self._subscribed
            if overlap(existing, unwanted) and not any(overlap(existing, filter_) for filter_ in wanted)
        ]
        self._subscribed = [existing for existing in self._subscribed if existing not in idle]
        return idle


class OwnMessageFilter:
    """A filter that recognises own retained messages that come back, and retained messages that come twice.

    For as-published connections, where retained and live messages look alike (T7). Only for messages with ``retain``.
    """

    def __init__(self) -> None:
        # Digests by topic:
        self._own = BoundedTable[bytes](_LIMIT, _BYTES, len)  # of our newest payload, until another client publishes,
        self._seen = BoundedTable[bytes](_LIMIT, _BYTES, len)  # and of the newest payload received
        self._repeats: set[str] = set()  # topics whose retained message will come a second time

    def begin(self) -> None:
        """Start a new connection, on which every retained message is new, except our own."""
        self._seen.clear()
        self._repeats.clear()

    def note_own(self, message: Message) -> None:
        """Remember a message that this client publishes."""
        self._own[message.topic] = _digest(message)

    def subscribe_again(self, filter_: str) -> None:
        """Expect the retained messages that ``filter_`` matches to be sent once more."""
        if is_pattern(filter_):
            self._repeats.update(topic for topic in list(self._seen) if overlap(topic, filter_))
        elif self._seen.has(filter_):
            self._repeats.add(filter_)

    def is_echo(self, message: Message) -> bool:
        """True if this is our own retained message, sent back to us; else forget ours, which is outdated."""
        if message.topic not in self._own:
            return False
        if self._own.get(message.topic) == _digest(message):
            return True
        self._own.pop(message.topic, None)  # another client has published since
        return False

    def is_repeat(self, message: Message) -> bool:
        """True if this is the repeated message that `subscribe_again` expects on its topic. Remembers the message."""
        known_digest, digest = self._seen.get(message.topic), _digest(message)
        self._seen[message.topic] = digest
        if known_digest != digest or message.topic not in self._repeats:
            return False
        self._repeats.discard(message.topic)
        return True


def _digest(message: Message) -> bytes:
    return blake2b(message.payload, digest_size=16).digest()
