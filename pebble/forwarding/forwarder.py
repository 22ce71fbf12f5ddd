"""Carries messages between a robot's own transport and another one, by a routing table: what bridge and mirror share.

Messages go straight from one side's receiving thread into the other side's `publish`, which takes a bounded time: no
hop between threads on the way of a drive command. Everything that is to be kept passes under one lock, because two
sides may change the same flag at once; commands and streams never wait for it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from enum import Enum

from pebble.contract import Kind
from pebble.forwarding.agreement import Agreement, Verdict
from pebble.forwarding.echoes import Echoes
from pebble.forwarding.outage import EventBuffer
from pebble.forwarding.routing import URGENT, Drop, Forward, Rules, Side, route
from pebble.forwarding.subjects import Subject, Subjects
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

#: Kept copies follow a subscription's confirmation closely: by then they have come even over a slow link.
SETTLE_S = 0.5
#: On connections that mark live messages like kept copies, the first message of a topic within this time after
#: :func:`barrier` counts as a copy.
_COPIES_S = 0.05
_EARLY = 4096  # kept topics that wait for the gate to open

_DROPS = {Verdict.KNOWN: Drop.KNOWN, Verdict.HOLD: Drop.HELD}


class Gate(Enum):
    WAITING = "waiting"  # nothing passes yet; kept state and events wait
    OPEN = "open"
    SHUT = "shut"  # nothing passes


class Forwarder:
    """Two transports and a table. Whoever owns it makes the subscriptions and says when a connection has settled.

    ``winner`` is the side that is right about two-way kept topics when kept copies differ (see .agreement).
    ``agreed(subject, payload)`` is told, on any thread and with a lock held, what a two-way kept topic says now.
    """

    def __init__(
        self,
        subjects: Subjects,
        rules: Rules,
        transports: Mapping[Side, Transport],
        *,
        winner: Side,
        agreed: Callable[[Subject, bytes], None] = lambda _subject, _payload: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.gate = Gate.WAITING
        self.mirroring = False
        self.counters = Counters()
        self._subjects, self._rules, self._transports = subjects, rules, transports
        self._winner, self._agreed, self._clock = winner, agreed, clock
        self._lock = threading.RLock()
        self._agreement = Agreement(winner)
        self._early: dict[str, tuple[Message, Forward]] = {}
        self._events = {side: EventBuffer(transports[side], self.counters, clock=clock) for side in Side}
        self._echoes = {side: Echoes(clock) for side in Side}
        self._copies_until = {side: float("inf") for side in Side}
        self._restarted: set[Side] = set()
        self._mirror_refused = False

    # -- life of the connections

    def watch(self, side: Side, state: State) -> None:
        """To be called from the watcher of each side's state, before anything else is done about it."""
        self._events[side].watch(state)
        if state is not State.CONNECTED:
            self._copies_until[side] = float("inf")
            self._restarted.add(side)

    def subscribed(self, side: Side) -> None:
        """``side`` is connected and subscribed to, and what it keeps has come."""
        self._copies_until[side] = self._clock() + _COPIES_S
        if self.gate is Gate.OPEN:
            self._events[side].flush()

    def settle(self, side: Side) -> None:
        """SETTLE_S after :meth:`subscribed`: settle what is open about kept topics."""
        with self._lock:
            self._renew()
            for to, topic, payload in self._agreement.settle(side):
                self._say_agreed(topic)
                self._tell(to, topic, payload)

    @property
    def settled(self) -> bool:
        """Is nothing open about kept topics?"""
        with self._lock:
            self._renew()
            return self._agreement.settled

    def open(self) -> None:
        """From now on messages pass; first what has waited."""
        with self._lock:
            self.gate = Gate.OPEN
            early, self._early = self._early, {}
            for message, forward in early.values():
                self._publish(Side.REMOTE, message, forward)
        self._events[Side.REMOTE].flush()

    def shut(self) -> None:
        """From now on nothing passes. Does not wait for anybody: a loop must end at once."""
        self.gate = Gate.SHUT
        self._early = {}
        for events in self._events.values():
            events.clear()

    # -- the receiving threads

    def receive(self, side: Side, message: Message) -> Forward | Drop:
        """Pass ``message`` on as the table says; returns what became of it."""
        subject = self._subjects[message.topic]
        result = self._receive(side, subject, message)
        if isinstance(result, Drop):
            self.counters.add(f"{side.value}: {result.value}")
        else:
            self.counters.add(f"{side.value}: forwarded")
        return result

    def _receive(self, side: Side, subject: Subject | None, message: Message) -> Forward | Drop:
        forward = route(self._rules, side, subject, message, mirroring=self._may_mirror())
        if isinstance(forward, Drop) or subject is None:
            return forward if isinstance(forward, Drop) else Drop.FOREIGN
        if self._is_echo(side, subject, message):
            return Drop.ECHO
        if forward.retain:
            return self._pass_kept(side, subject, message, forward)
        if self.gate is not Gate.OPEN:
            return self._hold_event(side, subject, message)
        if _is_event(subject, message):
            self._events[side.other].send(message)
        else:
            self._publish(side.other, message, forward)
        return forward

    def _hold_event(self, side: Side, subject: Subject, message: Message) -> Drop:
        if self.gate is Gate.WAITING and _is_event(subject, message):
            self._events[side.other].hold(message)
            return Drop.HELD
        return Drop.CLOSED

    def _pass_kept(self, side: Side, subject: Subject, message: Message, forward: Forward) -> Forward | Drop:
        with self._lock:
            self._renew()
            if self._rules.both_ways(subject.kind):
                drop = self._disagreement(side, subject, message)
                if drop is not None:
                    return drop
            if self.gate is Gate.OPEN:
                self._publish(side.other, message, forward)
                return forward
            if self.gate is Gate.WAITING and side is Side.LOCAL:
                if message.topic in self._early or len(self._early) < _EARLY:
                    self._early[message.topic] = message, forward
                return Drop.HELD
            return Drop.CLOSED

    # -- two-way kept topics, with the lock held

    def _disagreement(self, side: Side, subject: Subject, message: Message) -> Drop | None:
        """Why a two-way kept message must not pass; None if it may."""
        topic, payload = message.topic, message.payload
        kept = self.gate is not Gate.SHUT and self._is_copy(side, message)
        if not kept and not self._echo_is_exact(any) and self._agreement.value(topic) == payload:
            return Drop.KNOWN
        away = self._transports[side.other].state is not State.CONNECTED
        verdict = self._agreement.hear(side, topic, payload, kept=kept, other_away=away)
        if verdict is Verdict.PASS:
            self._agreed(subject, payload)
            return None
        if verdict is Verdict.RETELL:
            self._tell(side, topic, self._agreement.value(topic) or b"")
        return _DROPS.get(verdict, Drop.OVERRULED)

    def _is_copy(self, side: Side, message: Message) -> bool:
        if not message.retain:
            return False
        if not self._transports[side].as_published:
            return True
        return self._clock() < self._copies_until[side] and not self._agreement.heard(side, message.topic)

    def _renew(self) -> None:
        while self._restarted:
            self._agreement.begin(self._restarted.pop())

    def _say_agreed(self, topic: str) -> None:
        subject, payload = self._subjects[topic], self._agreement.value(topic)
        if subject is not None and payload is not None:
            self._agreed(subject, payload)

    def _tell(self, side: Side, topic: str, payload: bytes) -> None:
        subject = self._subjects[topic]
        if self.gate is Gate.OPEN and subject is not None:
            self._publish(side, Message(topic, payload), Forward(QoS.DELIVERED, True, subject.kind in URGENT))

    # -- sending

    def _publish(self, side: Side, message: Message, forward: Forward) -> None:
        topic, payload, transport = message.topic, message.payload, self._transports[side]
        subject = self._subjects[topic]
        if subject is None:
            return
        echoing = not transport.exact_echo and _echo_matters(subject)
        if echoing:
            self._echoes[side].expect(topic, payload)
        accepted = transport.publish(topic, payload, qos=forward.qos, retain=forward.retain, urgent=forward.urgent)
        if not accepted:
            self.counters.add(f"{side.value}: refused")
        if echoing and (not accepted or transport.state is not State.CONNECTED):
            self._echoes[side].forget(topic)
        if forward.retain and self._rules.both_ways(subject.kind):
            self._agreement.tell(side, topic, payload)

    def _is_echo(self, side: Side, subject: Subject, message: Message) -> bool:
        if self._transports[side].exact_echo or message.retain or not _echo_matters(subject):
            return False
        return self._echoes[side].is_echo(message.topic, message.payload)

    def _echo_is_exact(self, over: Callable[[list[bool]], bool]) -> bool:
        return over([transport.exact_echo for transport in self._transports.values()])

    def _may_mirror(self) -> bool:
        """A broker that sends our own commands back would repeat each one, a moment later: after the stop, too."""
        if not self.mirroring:
            self._mirror_refused = False
            return False
        if self._echo_is_exact(all):
            return True
        if not self._mirror_refused:
            self._mirror_refused = True
            log.error(
                "remote-mirror is refused: a broker sends our own messages back; use one with bridge mode "
                '(mosquitto), or protocol "5" on both sides'
            )
        return False


def barrier(transport: Transport, filter_: str) -> None:
    """Wait, bounded, until ``transport``'s other end has dealt with all we sent, and its kept copies have come.

    A subscription is confirmed after everything before it. ``filter_`` should be one we listen to anyway: a broker may
    forbid others.
    """
    transport.subscribe(filter_, _ignore, echo=False, direct=True, limit=1).close()


def _ignore(_message: Message) -> None:
    """Received only because a barrier has to subscribe to something."""


def _is_event(subject: Subject, message: Message) -> bool:
    return subject.kind is Kind.EVENT and message.qos is QoS.DELIVERED


def _echo_matters(subject: Subject) -> bool:
    """What is forwarded both ways whether remote-mirror is on or not."""
    return subject.kind in (Kind.FLAG, Kind.ACTION)
