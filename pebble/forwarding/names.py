"""Senders of messages at the level ``named``, where the broker vouches for the account in a message's topic. Pure.

On the robot itself the topic is without the account, and the sender stands in the payload. What has none is from a
program of the robot. An extension reads and writes the names.
"""

from abc import ABC, abstractmethod

from msgspec import Struct

from pebble.forwarding.routing import Drop
from pebble.forwarding.subjects import Subject
from pebble.transports import Message


class Sender(Struct, frozen=True):
    """The sender of a message, as far as its topic tells: the account, or NO_ACCOUNT.

    ``topic`` is the one without the name, and ``subject`` its meaning; None: it means nothing to this robot, because
    of ``foreign``.
    """

    account: str
    topic: str
    subject: Subject | None
    foreign: Drop = Drop.FOREIGN


class Signed(Struct, frozen=True):
    """A message as it passes, with its sender in the payload; ``by`` is that sender."""

    message: Message
    by: str


class Names(dict[str, Sender], ABC):
    """Senders by the topics of their messages."""

    @abstractmethod
    def sign(self, sender: Sender, message: Message) -> Signed | Drop:
        """Return ``message`` with its sender in the payload, and without in the topic, or why it does not pass."""
