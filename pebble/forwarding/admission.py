"""How much a robot takes from outside: everybody at the remote broker may send it anything."""

from __future__ import annotations

from pebble.contract import INCOMING, Kind
from pebble.contract.codec import MAX_COMMAND_BYTES
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.subjects import Subject
from pebble.transports import Message

MAX_UNKNOWN_FLAGS = 64  # each is retained on the robot: in its broker or hub, and in the hub's file


class Admission:
    """Bounds the messages to a robot, by size, and flags that are not in the contract by their number.

    What the robot itself has set counts as well, so a restarted bridge begins no new number, but is always admitted.
    """

    def __init__(self) -> None:
        self._flags: set[str] = set()

    def __len__(self) -> int:
        return len(self._flags)

    def refuse(self, side: Side, subject: Subject, message: Message) -> Drop | None:
        """Why this message may not pass; None if it may."""
        if side is Side.REMOTE and subject.kind.direction == INCOMING and len(message.payload) > MAX_COMMAND_BYTES:
            return Drop.TOO_LARGE
        if subject.channel is not None or subject.kind is not Kind.FLAG:
            return None
        if not message.payload:  # removed
            self._flags.discard(message.topic)
        elif side is Side.LOCAL or message.topic in self._flags or len(self._flags) < MAX_UNKNOWN_FLAGS:
            self._flags.add(message.topic)
        else:
            return Drop.TOO_MANY
        return None
