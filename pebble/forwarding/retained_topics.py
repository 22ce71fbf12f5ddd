"""Passes retained messages under one lock, because both sides may change the same flag at once."""

import threading
from collections.abc import Callable

from pebble.contract import Kind
from pebble.forwarding.publisher import Publisher
from pebble.forwarding.reconciliation import Reconciliation, Resolution
from pebble.forwarding.routing import URGENT, Drop, Forward, Side
from pebble.forwarding.side import Gate, Sides, SideState
from pebble.forwarding.subjects import Subject, Subjects
from pebble.transports import Message, QoS

_MAX_WAITING = 4096  # retained messages that wait for the gate to open; also topics in `SideState.seen`
_DROPS = {Resolution.KNOWN: Drop.KNOWN, Resolution.HOLD: Drop.HELD}


class RetainedTopics:
    """Retained messages of both sides. They wait here for the :class:`Gate`; then the value that counts is chosen.

    ``on_value(subject, payload)`` is called with the lock held.
    """

    def __init__(
        self,
        sides: Sides,
        subjects: Subjects,
        publisher: Publisher,
        winner: Side,  # the one whose values count where the two sides differ
        both_ways: frozenset[Kind],  # the kinds that pass in both directions
        on_value: Callable[[Subject, bytes], None],
    ) -> None:
        self._sides, self._subjects, self._publisher = sides, subjects, publisher
        self._both_ways, self._on_value = both_ways, on_value
        self._lock = threading.RLock()
        self._reconciliation = Reconciliation(winner)
        self._waiting: dict[str, tuple[Subject, Message, Forward]] = {}  # for the gate to open, by topic

    def receive(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, *, only_old: bool = False
    ) -> Forward | Drop:
        """Forward a message that will be retained, or return why not.

        ``only_old``: refuse a live message; what a broker had retained may pass.
        """
        with self._lock:
            self._begin_restarted()  # first: this may be the first message of a new connection
            if subject.kind in self._both_ways:
                drop = self._reconcile(source, subject, message, only_old=only_old)
                if drop is not None:
                    return drop
            gate = self._sides.gate
            if gate is Gate.OPEN:
                self._publish(source.side.other, subject, message, forward)
                return forward
            if gate is Gate.WAITING and source.side is Side.LOCAL:  # the remote side is subscribed to once it is open
                if message.topic in self._waiting or len(self._waiting) < _MAX_WAITING:  # else it is lost
                    self._waiting[message.topic] = subject, message, forward
                return Drop.HELD
            return Drop.CLOSED

    def change(self, subject: Subject, message: Message) -> Forward | Drop:
        """Publish a new value on both sides, as if a program on the robot had changed it."""
        with self._lock:
            self._begin_restarted()
            if self._sides.gate is not Gate.OPEN:
                return Drop.CLOSED
            self._reconciliation.receive(Side.LOCAL, message.topic, message.payload, retained=False)
            self._on_value(subject, message.payload)
            forward = Forward(QoS.DELIVERED, True, subject.kind in URGENT)  # True: retained
            for side in Side:
                self._publish(side, subject, message, forward)
            return forward

    def open(self) -> None:
        """Open the gate between the sides, and publish the messages that have waited."""
        with self._lock:
            self._sides.gate = Gate.OPEN
            waiting, self._waiting = self._waiting, {}
            for subject, message, forward in waiting.values():
                self._publish(Side.REMOTE, subject, message, forward)

    def shut(self) -> None:
        """Close the gate: nothing passes any more. Takes no lock, as a loop of messages must end at once."""
        self._sides.gate = Gate.SHUT
        self._waiting = {}

    def synchronize(self, side: Side) -> None:
        """Publish the values that were held back until the retained messages of ``side`` had arrived."""
        with self._lock:
            self._begin_restarted()
            self._sides[side].arrived()
            for to, topic, payload in self._reconciliation.synchronize(side):
                # Observers get the value that counts: none where the bounded table had no room to keep this payload.
                subject, newest = self._subjects[topic], self._reconciliation.value(topic)
                if subject is not None and newest is not None:
                    self._on_value(subject, newest)
                self._publish_value(to, topic, payload)

    def synchronized(self, *sides: Side) -> bool:
        """True if the retained messages of ``sides`` have arrived."""
        with self._lock:
            self._begin_restarted()
            return self._reconciliation.has_synchronized(*sides)

    def value(self, topic: str) -> bytes | None:
        """Return the newest value of a two-way topic."""
        return self._reconciliation.value(topic)

    def remove(self, side: Side, topic: str, *, unless: Callable[[str], bool]) -> bool:
        """Remove the retained message of ``side`` on ``topic``, unless ``unless(topic)``; True if it was removed.

        No retained message passes before the removal is sent, so one that is published in the meantime comes after it.
        """
        with self._lock:
            if unless(topic):
                return False
            self._sides[side].transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True)
            return True

    # -- with the lock held

    def _reconcile(self, source: SideState, subject: Subject, message: Message, *, only_old: bool) -> Drop | None:
        """Return why a message of either side must not pass; None if it may. ``only_old``: no live message may pass."""
        side, topic, payload, transport = source.side, message.topic, message.payload, source.transport
        if message.retain and topic in source.seen and transport.policy.delivers_late and not transport.as_published:
            return Drop.KNOWN  # without as_published, `retain` marks an old message: the one seen before is newer
        if len(source.seen) < _MAX_WAITING:
            source.seen.add(topic)
        retained = self._sides.gate is not Gate.SHUT and self._is_retained(source, message)  # shut: all count as live
        if only_old and not retained:
            return Drop.UNNAMED  # live, and its sender has no account: only an old one may be the robot's own
        ours_may_come_back = not any(state.transport.exact_echo for state in self._sides.values())
        if not retained and ours_may_come_back and self._reconciliation.value(topic) == payload:
            return Drop.KNOWN
        resolution = self._reconciliation.receive(
            side,
            topic,
            payload,
            retained=retained,
            other_away=not self._sides[side.other].connected,
            went_back=source.has_gone_back,
        )
        if resolution is Resolution.RESTORE:
            self._publish_value(side, topic, payload)  # back to the sender's side; the caller sends it to the other
        if resolution in (Resolution.PASS, Resolution.RESTORE):
            self._on_value(subject, payload)
            return None
        if resolution is Resolution.CORRECT:
            self._publish_value(side, topic, self._reconciliation.value(topic) or b"")
        return _DROPS.get(resolution, Drop.OVERRULED)

    def _is_retained(self, source: SideState, message: Message) -> bool:
        """True if a message is, or may be, an old one that a subscription brought."""
        if not source.transport.as_published:
            return message.retain
        return source.window.may_be_old(message) and not self._reconciliation.has_received(source.side, message.topic)

    def _begin_restarted(self) -> None:
        """Forget what a side has sent on an earlier connection: on the new one its retained messages come again."""
        for state in self._sides.values():
            if state.restarted:
                state.restarted = False
                self._reconciliation.begin(state.side)

    def _publish_value(self, side: Side, topic: str, payload: bytes) -> None:
        subject = self._subjects[topic]
        if self._sides.gate is Gate.OPEN and subject is not None:
            self._publish(side, subject, Message(topic, payload), Forward(QoS.DELIVERED, True, subject.kind in URGENT))

    def _publish(self, to: Side, subject: Subject, message: Message, forward: Forward) -> None:
        self._publisher.publish(self._sides[to], subject, message, forward)
        if subject.kind in self._both_ways:
            self._reconciliation.note_published(to, message.topic, message.payload)
