"""Sends messages that leave a robot through a sieve, while the link to its remote side is not wide.

The sieve keeps the newest message of each topic until the link has room for it. An expander is a program beside the
remote broker that takes groups of streams apart. While there is one, streams leave in such groups instead: one message
has the newest of each.
"""

import threading
from collections.abc import Iterable

from pebble.contract import EXPANDER
from pebble.extensions.thin.group_gate import GroupGate
from pebble.extensions.thin.sieve import Rank, Sieve, Waiting, rank_of
from pebble.extensions.thin.stream_groups import StreamGroups
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.routing import Drop, Forward, Side
from pebble.forwarding.side import Gate, SideState
from pebble.forwarding.subjects import Subject
from pebble.transports import Message


class Sifter:
    """A switch for messages that leave the robot: to the sieve, a group of streams, or the forwarder; thread-safe."""

    def __init__(self, forwarder: Forwarder, way: Forwarder | GroupGate, groups: StreamGroups | None) -> None:
        """Store the arguments; ``way``: the part that forwards messages, the forwarder itself or a gate before it."""
        self._forwarder, self._way, self._sides = forwarder, way, forwarder.sides
        self._sieve: Sieve | None = None
        self._groups = groups
        self._lock = threading.RLock()  # so that a message which has waited is not sent after a newer one

    def use(self, sieve: Sieve | None) -> None:
        """Pass messages through ``sieve``, whose owner calls :meth:`send_waiting`; None: pass them at once.

        Events wait in a buffer of their own (EventBuffer), which asks the sieve for room by ``has_room``.
        """
        with self._lock:
            former, self._sieve = self._sieve, sieve
            self._way.pass_on = self._forwarder.pass_now if sieve is None else self._sift
            events = self._sides[Side.REMOTE].events
            events.has_room = None if sieve is None else sieve.takes_event
            if former is not None and sieve is None:
                self._send(former.take_all())
                events.resume()

    def send_waiting(self) -> None:
        """Send the messages that wait in the sieve, as far as there is room."""
        with self._lock:
            if self._sieve is not None:
                self._send(self._sieve.due(Rank.STATE))
                self._sides[Side.REMOTE].events.resume()
                self._send(self._sieve.due(Rank.STREAM))

    def _send(self, waiting: Iterable[Waiting]) -> None:
        robot = self._sides[Side.LOCAL]
        for entry in waiting:
            if isinstance(self._forwarder.pass_now(robot, entry.subject, entry.message, entry.forward), Forward):
                robot.count_forwarded()

    def _sift(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, account: str
    ) -> Forward | Drop:
        """Send a message that may be forwarded, or keep it: in the sieve, or for the next group of streams.

        Return NO_ROOM for one that is kept, as it is not forwarded yet. For the others return the result of
        :meth:`Forwarder.pass_now`: how it was forwarded, or why not. An expander's announcement stays here.
        """
        if source.side is not Side.LOCAL or subject.prompt:  # it enters the robot, or must not wait
            if self._groups is not None and subject.channel is EXPANDER:
                self._groups.heard(message.payload)  # an announcement for the bridge itself
                return Drop.STAYS
            return self._forwarder.pass_now(source, subject, message, forward, account)
        if self._groups is not None and self._joins(subject, message, forward) and self._groups.takes(message):
            return Drop.NO_ROOM
        with self._lock:
            sieve = self._sieve
            if sieve is not None and self._sides.gate is Gate.OPEN and sieve.keeps(subject, message, forward):
                return Drop.NO_ROOM
            return self._forwarder.pass_now(source, subject, message, forward)  # the robot's own has no account

    def _joins(self, subject: Subject, message: Message, forward: Forward) -> bool:
        """True if a message may leave in a group of streams."""
        return not forward.retain and self._sides.gate is Gate.OPEN and rank_of(subject, message) is Rank.STREAM
