"""Limits for messages to a robot, because any client may send anything."""

import time
from collections.abc import Callable

from pebble.contract import INCOMING, Channel, Kind
from pebble.contract.codec import MAX_COMMAND_BYTES
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.subjects import Subject
from pebble.transports import Message

MAX_ACTIONS = 10  # of one topic in a second: the rest requests what is requested already
MAX_UNKNOWN_COMMANDS = 1000  # in a second, of all topics together
MAX_UNKNOWN_FLAGS = 64  # each is retained on the robot: in its broker or hub, and in the hub's file


class Admission:
    """Limits on size, and on the number of actions and of messages that the contract does not know.

    Of unknown flags from outside a limited number is admitted. Flags from the robot's side are always admitted, and
    count as well: there a restarted bridge finds the retained ones that it had passed on before.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._flags: set[str] = set()  # topics of unknown flags that were admitted, and were not removed since
        self._clock = clock
        self._second = 0  # the present one, whose messages are counted
        self._counts: dict[tuple[Kind | Channel, bool], int] = {}  # of this second, with a name and without one

    def refuse(self, side: Side, subject: Subject, message: Message, topic: str, *, named: bool = True) -> Drop | None:
        """Return why this message may not pass to ``topic``; None if it may. Must be fast.

        Counts the message if its kind is limited, and remembers an unknown flag. ``named`` is False if topics
        must name the sender's account, and this one does not: such messages have a limit of their own.
        """
        is_large = side is Side.REMOTE and len(message.payload) > MAX_COMMAND_BYTES
        if is_large and subject.kind.direction == INCOMING and not subject.is_stop:  # any payload is a stop
            return Drop.TOO_LARGE
        return self._refuse_limited(side, subject, message, topic, named) if subject.counted else None

    def _refuse_limited(self, side: Side, subject: Subject, message: Message, topic: str, named: bool) -> Drop | None:
        """Return why one more message of a limited kind may not pass; None if it may. It is counted."""
        if side is Side.REMOTE and self._is_too_often(subject, message, named):  # counts it
            return Drop.TOO_OFTEN
        if subject.kind is not Kind.FLAG or subject.channel is not None:
            return None
        if not message.payload:  # a removal, which needs no room
            if side is Side.REMOTE and topic not in self._flags:
                return Drop.KNOWN  # the robot has no such flag: it is removed already
            self._flags.discard(topic)
        elif side is Side.LOCAL or topic in self._flags or len(self._flags) < MAX_UNKNOWN_FLAGS:
            self._flags.add(topic)
        else:
            return Drop.TOO_MANY
        return None

    def refuses_flag(self, topic: bytes) -> bool:
        """True if the contract does not know this flag, and there is no room for another unknown flag."""
        return len(self._flags) >= MAX_UNKNOWN_FLAGS and topic.decode(errors="replace") not in self._flags

    def _is_too_often(self, subject: Subject, message: Message, named: bool) -> bool:
        """Count an action or unknown command; True if this second has had too many of them."""
        if subject.kind is Kind.ACTION and subject.channel is not None:
            key: Kind | Channel = subject.channel
            most = MAX_ACTIONS
        elif subject.kind is Kind.COMMAND and subject.channel is None:
            key, most = subject.kind, MAX_UNKNOWN_COMMANDS
        else:
            return False
        if message.payload.isspace():  # perhaps a probe for cycles
            return False
        second = int(self._clock())
        if second != self._second:
            self._second = second
            self._counts.clear()
        count = self._counts[key, named] = self._counts.get((key, named), 0) + 1
        return count > most
