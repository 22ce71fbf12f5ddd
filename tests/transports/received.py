"""A handler that remembers, for every test of this folder."""

from __future__ import annotations

from pebble.transports import Message
from tests.support import until


class Received:
    """Call it with messages; look at what came."""

    def __init__(self) -> None:
        self.messages: list[Message] = []

    def __call__(self, message: Message) -> None:
        self.messages.append(message)

    @property
    def payloads(self) -> list[bytes]:
        return [message.payload for message in self.messages]

    def until(self, *payloads: bytes, timeout: float = 10.0) -> bool:
        """Have exactly these payloads arrived, in this order?"""
        return until(lambda: self.payloads == list(payloads), timeout)
