"""What waits in front of a socket that takes no more: bounded, newest wins (T4)."""

from __future__ import annotations

import itertools

from pebble.transports.base import Message

MESSAGES = 64  # that are not kept
BYTES = 256 * 1024  # of their payloads; one message may always wait, whatever its size


class Backlog:
    """LATEST messages in order. The oldest gives way to the newest, a kept one only to a newer one of its topic."""

    def __init__(self) -> None:
        self._waiting: dict[str | int, Message] = {}  # kept ones by topic, the others by number
        self._numbers = itertools.count()
        self._live_bytes = 0
        self._live = 0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def size(self) -> int:
        """Bytes of all payloads that wait."""
        return sum(len(message.payload) for message in self._waiting.values())

    def __contains__(self, topic: str) -> bool:
        return topic in self._waiting

    def put(self, message: Message) -> int:
        """Append ``message``; returns how many messages it pushed out."""
        if message.retain:
            pushed_out = self._waiting.pop(message.topic, None) is not None
            self._waiting[message.topic] = message
            return int(pushed_out)
        self._waiting[next(self._numbers)] = message
        self._live += 1
        self._live_bytes += len(message.payload)
        dropped = 0
        while self._live > 1 and (self._live > MESSAGES or self._live_bytes > BYTES):
            self._remove(next(key for key in self._waiting if isinstance(key, int)))
            dropped += 1
        return dropped

    def take(self) -> Message:
        return self._remove(next(iter(self._waiting)))

    def supersede(self, newer: Message) -> int:
        """A DELIVERED message goes ahead: what waits on its topic is stale (T8). Returns how many that were."""
        stale = [
            key
            for key, message in self._waiting.items()
            if message.topic == newer.topic and (newer.retain or not message.retain)
        ]
        for key in stale:
            self._remove(key)
        return len(stale)

    def _remove(self, key: str | int) -> Message:
        message = self._waiting.pop(key)
        if isinstance(key, int):
            self._live -= 1
            self._live_bytes -= len(message.payload)
        return message
