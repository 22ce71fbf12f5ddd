"""Senders of messages at the level ``named``, where the broker checks the account in a message's topic. Pure.

On the robot itself topics are without accounts, and the sender stands in the payload. A message without a sender is
from a program of the robot. An extension reads and writes the names.
"""

from abc import ABC, abstractmethod

from msgspec import Struct

from pebble.forwarding.routing import Drop
from pebble.forwarding.subjects import Subject
from pebble.transports import Message


class Sender(Struct, frozen=True):
    """The sender of a message by its topic: the account, or NO_ACCOUNT.

    ``topic`` is the topic without the name, and ``subject`` its meaning. ``subject`` is None if the topic means nothing
    to this robot; ``foreign`` is the reason.
    """

    account: str
    topic: str
    subject: Subject | None
    foreign: Drop = Drop.FOREIGN


class Signed(Struct, frozen=True):
    """A message with its sender in the payload, as it is forwarded; ``by`` is that sender."""

    message: Message
    by: str


class Names(dict[str, Sender], ABC):
    """Finds the senders of messages by their topics."""

    @abstractmethod
    def sign(self, sender: Sender, message: Message) -> Signed | Drop:
        """Return ``message`` with its sender in the payload instead of the topic, or why it does not pass."""
