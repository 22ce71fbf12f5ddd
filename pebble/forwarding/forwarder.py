"""Forwards messages between a robot's own transport and another one, by a routing table.

A message is published on the other side by the thread that received it, in a bounded time: a drive command never waits
for another thread. All retained messages pass under one lock, because both sides may change the same flag at once;
commands and streams never wait for it.

Retained commands are stale. A live emergency stop passes even if it was published to be retained: a stop that does not
arrive is worse than one that a later subscriber must recognise as old. What happens once is also stale when it has
waited, in a process that was stopped or stuck, or at the broker; what only ends something never is.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from enum import Enum

import msgspec

from pebble.contract import (
    AUDIO_CONTROL,
    AUTONOMY_COMMAND,
    DRIVE,
    GIT_PULL,
    LIGHTS_FLASH,
    LIGHTS_SOLID,
    OUTGOING,
    OUTLET_COMMAND,
    REBOOT,
    SERVICE_RESTART,
    SOUNDBOARD_COMMAND,
    VIDEO_CONTROL,
    Kind,
    codec,
)
from pebble.errors import PayloadError
from pebble.forwarding.admission import Admission
from pebble.forwarding.cycles import STORM, SUSPICIOUS, Cycles, Finding
from pebble.forwarding.event_buffer import EventBuffer
from pebble.forwarding.loopback_filter import LoopbackFilter
from pebble.forwarding.reconciliation import Reconciliation, Resolution
from pebble.forwarding.routing import ONE_SHOT, URGENT, Drop, Forward, Rules, Side, route
from pebble.forwarding.signatures import unsigned
from pebble.forwarding.subjects import Subject, Subjects
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.counters import Counters, bounds_reached

log = logging.getLogger(__name__)

#: Retained messages closely follow the acknowledgement of a subscription: by then they are here even over a slow link.
INITIAL_SYNC_S = 0.5
#: Some brokers send them later: they are all here after a silence this long.
QUIET_S = 0.25
#: On connections where live messages may have the retain flag, too, the first message of a topic within this time
#: after :func:`barrier` counts as an old one.
_RETAINED_S = 0.05
#: A broker sends few retained messages at a time, so over a slow link the last ones arrive long after the first. While
#: others with the retain flag keep arriving, a stop with it counts as an old one, but not for longer than this.
_RETAINED_STOPS_S = 10.0
_LOGGED = 200  # characters of a topic
_LATE_S = 0.5  # what happens once and has waited for longer is stale
_PATIENT_S = 2.0  # the same, of what moves nothing
_PATIENT = (LIGHTS_SOLID, LIGHTS_FLASH, SOUNDBOARD_COMMAND, VIDEO_CONTROL, AUDIO_CONTROL)
_SWITCHES = (AUTONOMY_COMMAND, OUTLET_COMMAND, SOUNDBOARD_COMMAND, VIDEO_CONTROL, AUDIO_CONTROL)
#: After a longer outage an earlier value at a broker that was restored may have been chosen again by somebody.
_RESTORED_S = 30.0
_MAX_WAITING = 4096  # retained messages that wait for the gate to open
#: What circulates comes back within this time; the same message later is new.
_RETURN_S = 2.0
#: Probed at each connection, before they are used.
_PROBED = (DRIVE, REBOOT, SERVICE_RESTART, GIT_PULL)

_BOUNDS = (Drop.TOO_LARGE, Drop.TOO_MANY, Drop.TOO_OFTEN, Drop.LATE, Drop.CIRCULATES, Drop.SIGNED)
_DROPS = {Resolution.KNOWN: Drop.KNOWN, Resolution.HOLD: Drop.HELD}


class Gate(Enum):
    WAITING = "waiting"  # nothing passes yet; retained messages and events wait
    OPEN = "open"
    SHUT = "shut"  # nothing passes


class Routed(msgspec.Struct, frozen=True):
    """What became of a received message; ``subject`` is None for a topic that is not this robot's."""

    subject: Subject | None
    outcome: Forward | Drop


class Forwarder:
    """Forwards between two transports. Its owner subscribes, and calls :meth:`synchronize` after each subscription.

    ``winner`` is the side whose retained messages count where they differ (see .reconciliation).
    ``on_value(subject, payload)`` is called, on any thread and with a lock held, with each new value of a two-way
    retained topic.
    """

    def __init__(
        self,
        subjects: Subjects,
        rules: Rules,
        transports: Mapping[Side, Transport],
        *,
        winner: Side,
        on_value: Callable[[Subject, bytes], None] = lambda _subject, _payload: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.gate = Gate.WAITING
        self.counters = Counters()
        self._count_forwarded = {side: self.counters.adder(f"{side.value}: forwarded") for side in Side}
        self._subjects, self._rules, self._transports = subjects, rules, transports
        self._winner, self._on_value, self._clock = winner, on_value, clock
        self._both_ways = frozenset(kind for kind in Kind if rules.both_ways(kind))
        #: What :func:`route` has returned. There are not many subjects, so it needs no bound.
        self._routes: dict[tuple[Side, Subject, QoS, bool, bool | None, bool], Forward | Drop] = {}
        for transport in transports.values():
            transport.is_stop = self._is_stop
        self._lock = self.retained_lock = threading.RLock()  # while it is held no retained message passes
        self._reconciliation = Reconciliation(winner)
        self._admission = Admission(clock)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self._waiting: dict[str, tuple[Subject, Message, Forward]] = {}
        self._events = {side: EventBuffer(transports[side], self.counters, clock=clock) for side in Side}
        self._loopback = {side: LoopbackFilter(clock) for side in Side}
        self._cycles = Cycles(clock, yields=not rules.leaves_robot)  # a mirror, to the bridge
        self._returns = {side: LoopbackFilter(clock, _RETURN_S) for side in Side}  # what circulates, once each
        self._retained_until = {side: float("inf") for side in Side}
        self._subscribed_at = {side: float("inf") for side in Side}
        self._retained_at = {side: float("-inf") for side in Side}  # the newest of the messages that may be old
        self._stops_retained_until = {side: float("inf") for side in Side}
        self._restarted: set[Side] = set()
        self._lost_at = {side: float("-inf") for side in Side}  # -inf: before the first connection, too
        self._went_back = dict.fromkeys(Side, False)
        self._seen: dict[Side, set[str]] = {side: set() for side in Side}  # two-way topics, since we subscribed
        self._mirroring = self._mirror_refused = False

    @property
    def mirroring(self) -> bool:
        """Whether remote-mirror is on."""
        return self._mirroring

    @mirroring.setter
    def mirroring(self, on: bool) -> None:
        self._mirroring, self._mirror_refused = on, on and self._mirror_refused

    def dropped(self) -> dict[str, int]:
        """How many messages did not pass, here or in a transport, because of a bound; by reason, like ``too_many``."""
        found = Counter(bounds_reached(*(transport.counters for transport in self._transports.values())))
        for one, side in itertools.product(_BOUNDS, Side):
            found[one.name.lower()] += self.counters[f"{side.value}: {one.value}"]
        return {**found, "events": self.counters["events_dropped"]}

    # -- connections

    def subscribing(self, side: Side) -> None:
        """The owner is about to subscribe to ``side``: its retained messages arrive from now on."""
        self._retained_at[side] = float("-inf")
        self._seen[side].clear()
        self._retained_until[side] = self._stops_retained_until[side] = float("inf")

    def watch(self, side: Side, state: State) -> None:
        """Follow the state of ``side``; the owner calls this first in its own callback."""
        self._events[side].watch(state)
        if state is not State.CONNECTED:
            self.subscribing(side)  # the transport does so at the next connection
            self._restarted.add(side)
            self._lost_at[side] = self._clock()
            # Known before its retained messages come, which may be before it counts as connected.
            self._went_back[side] = side is not self._winner and self._transports[side].was_ended
        elif side is self._winner:
            self._went_back[side] = self._was_brief(side) and self._transports[side].went_back

    def _was_brief(self, side: Side) -> bool:
        return self._clock() - self._lost_at[side] < _RESTORED_S

    def _has_gone_back(self, side: Side) -> bool:
        """Whether an earlier value that ``side`` retains is an old one: no program can have chosen it again."""
        if side is self._winner or not self._went_back[side]:
            return self._went_back[side]
        return self._was_brief(side) or self._transports[side].was_ended

    def subscribed(self, side: Side) -> None:
        """``side`` is connected and subscribed to, and its retained messages have arrived."""
        self._subscribed_at[side] = now = self._clock()
        self._retained_until[side] = now + _RETAINED_S
        self._stops_retained_until[side] = max(now + _RETAINED_S, self._retained_at[side] + INITIAL_SYNC_S)
        if self.gate is Gate.OPEN:
            self._events[side].flush()

    def is_arriving(self, side: Side) -> bool:
        """Whether retained messages of ``side`` have come until just now."""
        return self._clock() - self._retained_at[side] < QUIET_S

    def synchronize(self, side: Side) -> None:
        """Publish what retained messages have left open; to be called INITIAL_SYNC_S after :meth:`subscribed`."""
        with self._lock:
            self._begin_restarted()
            self._went_back[side] = False
            for to, topic, payload in self._reconciliation.synchronize(side):
                self._report_value(topic)
                self._publish_value(to, topic, payload)

    @property
    def synchronized(self) -> bool:
        """Whether both sides are synchronized."""
        with self._lock:
            self._begin_restarted()
            return self._reconciliation.synchronized

    def open(self) -> None:
        """Forward from now on; first what has waited."""
        with self._lock:
            self.gate = Gate.OPEN
            waiting, self._waiting = self._waiting, {}
            for subject, message, forward in waiting.values():
                self._publish(Side.REMOTE, subject, message, forward)
        for events in self._events.values():
            events.flush()

    def shut(self) -> None:
        """Forward nothing from now on. Takes no lock: a loop of messages must end at once."""
        self.gate = Gate.SHUT
        self._waiting = {}
        for events in self._events.values():
            events.clear()

    def rearm(self) -> None:
        """After :meth:`shut`: messages wait for :meth:`open` again, and the remote side is synchronized anew."""
        if self.gate is Gate.SHUT:
            self.subscribing(Side.REMOTE)
            self._restarted.add(Side.REMOTE)
            self.gate = Gate.WAITING

    # -- cycles: what we forward to one side comes back from the other

    def probe_commands(self, *sides: Side) -> None:
        """Find out whether commands and actions from ``sides`` would circulate; after each connection."""
        for side in sides:
            for topic in self._subjects.topics(*_PROBED):
                self._probe(side, topic, b"")

    def probe_again(self, *sides: Side) -> None:
        """Find out whether what circulated does so still, and commands from ``sides`` as well; once a second.

        Commands were probed when a connection began; the other way may be younger.
        """
        for side, topic in self._cycles.poll():
            self._probe(side, topic, self._reconciliation.value(topic) or b"")
        if self._cycles.closed_ways:
            for side, topic in itertools.product(sides, self._subjects.topics(*_PROBED)):
                if (side, topic) not in self._cycles.closed_ways:
                    self._probe(side, topic, b"")

    def _probe(self, side: Side, topic: str, value: bytes) -> None:
        """Publish a probe on the other side, where something else may lead back to ``side``."""
        subject, transport = self._subjects[topic], self._transports[side.other]
        if subject is None or transport.state is not State.CONNECTED:
            return
        once = subject.kind in ONE_SHOT
        if once or _is_json(value):
            probe = (b"" if once else value) + self._cycles.probe(side, topic)
            transport.publish(topic, probe, qos=QoS.DELIVERED, urgent=subject.kind in URGENT)

    def _examine(self, side: Side, subject: Subject, message: Message) -> Finding:
        if subject.is_stop:
            repeated = self._cycles.repeats_stop(side, message.topic, message.payload)
            return Finding.CIRCULATES if repeated else Finding.PASS
        once = subject.kind in ONE_SHOT
        return self._cycles.receive(
            side, message.topic, message.payload, once=once, runs=subject.runs, after=_after(subject)
        )

    def _note_return(self, side: Side, subject: Subject, message: Message) -> None:
        """``message`` goes to ``side``; if its topic circulates, it comes back from the other one.

        What runs something is noted before it is known whether its topic circulates: its probe is still under way.
        """
        circulates = subject.kind not in ONE_SHOT and (side.other, message.topic) in self._cycles.closed_ways
        if circulates or subject.runs:
            self._returns[side.other].expect(message.topic, message.payload)

    # -- the receiving threads

    def skips_retained(self, side: Side, topic: bytes) -> bool:
        """Whether a retained message of ``topic`` does not pass, whatever it is: for Transport.skips_retained."""
        kind = self._subjects.invented(topic)
        if kind is None or (kind is Kind.FLAG and not self._admission.refuses_flag(topic)):
            return False
        drop = Drop.TOO_MANY if kind is Kind.FLAG else Drop.STALE
        self._note_retained(side)
        self.counters.add(f"{side.value}: {drop.value}")
        shown = topic[:_LOGGED].decode(errors="replace")
        self._quiet_log.warning(drop.name, "%s is not forwarded: %s", shown, drop.value)
        return True

    def receive(self, side: Side, message: Message) -> Routed:
        """Forward ``message`` by the table."""
        subject = self._subjects[message.topic]
        outcome = self._receive(side, subject, message)
        if isinstance(outcome, Drop):
            self.counters.add(f"{side.value}: {outcome.value}")
        else:
            self._count_forwarded[side]()
        return Routed(subject, outcome)

    def _receive(self, side: Side, subject: Subject | None, message: Message) -> Forward | Drop:
        """Hot: what nearly no message needs is asked for here, and done elsewhere."""
        if subject is None or not subject.is_stop:
            if message.retain:  # they still arrive: a stop may be among them, which does not count: it may be repeated
                self._note_retained(side)
        elif not self._is_old_stop(side, message):
            message = Message(message.topic, message.payload, message.qos)  # live: passes, and is retained nowhere
        if subject is None:
            return Drop.FOREIGN
        mirroring = self._mirroring and self._may_mirror()
        key = side, subject, message.qos, message.retain, message.retain_requested, mirroring
        forward = self._routes.get(key)
        if forward is None:
            forward = self._routes[key] = route(self._rules, side, subject, message, mirroring=mirroring)
        if isinstance(forward, Drop):
            return forward
        refused = self._admission.refuse(side, subject, message)
        if refused is Drop.KNOWN:
            return refused
        if refused is not None:
            self._quiet_log.warning(refused.name, "%s is not forwarded: %s", message.topic[:_LOGGED], refused.value)
            return refused
        if subject.kind in ONE_SHOT and (waited := message.waited_s) > _LATE_S and _is_late(subject, message, waited):
            return Drop.LATE
        is_exact = self._transports[side].exact_echo
        if (self._cycles.closed_ways or not is_exact) and self._is_echo(side, subject, message):
            return Drop.ECHO
        if self.gate is Gate.OPEN:
            finding = self._examine(side, subject, message)
            if finding is not Finding.PASS and (drop := self._act_on(finding, side, subject, message, forward)):
                return drop
        if forward.unsigned:
            passing = unsigned(message.payload)
            if passing is not message.payload:
                self._quiet_log.warning(Drop.SIGNED.name, "%s: %s", message.topic[:_LOGGED], Drop.SIGNED.value)
                if passing is None:
                    return Drop.SIGNED
                message = Message(message.topic, passing, message.qos)
                self.counters.add(f"{side.value}: zeros of a script, passed as a person's")
        if forward.retain:
            return self._pass_retained(side, subject, message, forward)
        is_event = subject.kind is Kind.EVENT and message.qos is QoS.DELIVERED
        if self.gate is not Gate.OPEN:
            return self._hold_event(side, message) if is_event else Drop.CLOSED
        if is_event:
            self._note_return(side.other, subject, message)
            self._events[side.other].send(message)
        else:
            self._publish(side.other, subject, message, forward)
        return forward

    def _act_on(
        self, finding: Finding, side: Side, subject: Subject, message: Message, forward: Forward
    ) -> Drop | None:
        """Why a message that is suspicious, or a probe, does not pass; None if it does."""
        match finding:
            case Finding.CIRCULATES:
                return Drop.CIRCULATES
            case Finding.SUSPECT:  # the probe goes first: it comes back before the message does
                self._probe(side, message.topic, message.payload)
                return None
            case Finding.RELAY:
                self._publish(side.other, subject, message, Forward(forward.qos, False, forward.urgent))
        return Drop.PROBE

    def _hold_event(self, side: Side, message: Message) -> Drop:
        if self.gate is Gate.SHUT:
            return Drop.CLOSED
        events = self._events[side.other]
        events.hold(message)
        if self.gate is not Gate.WAITING:  # it was opened or shut meanwhile, perhaps before this event was there
            (events.resume if self.gate is Gate.OPEN else events.clear)()
        return Drop.HELD

    def _pass_retained(self, side: Side, subject: Subject, message: Message, forward: Forward) -> Forward | Drop:
        with self._lock:
            self._begin_restarted()
            if subject.kind in self._both_ways:
                drop = self._reconcile(side, subject, message)
                if drop is not None:
                    return drop
            if self.gate is Gate.OPEN:
                self._publish(side.other, subject, message, forward)
                return forward
            if self.gate is Gate.WAITING and side is Side.LOCAL:
                if message.topic in self._waiting or len(self._waiting) < _MAX_WAITING:
                    self._waiting[message.topic] = subject, message, forward
                return Drop.HELD
            return Drop.CLOSED

    # -- two-way retained topics, with the lock held

    def _reconcile(self, side: Side, subject: Subject, message: Message) -> Drop | None:
        """Why a two-way retained message must not pass; None if it may."""
        topic, payload, seen = message.topic, message.payload, self._seen[side]
        transport = self._transports[side]
        if message.retain and topic in seen and transport.delivers_late and not transport.as_published:
            return Drop.KNOWN  # older than what was seen
        if len(seen) < _MAX_WAITING:
            seen.add(topic)
        retained = self.gate is not Gate.SHUT and self._is_retained(side, message)
        if not retained and not self._echo_is_exact(any) and self._reconciliation.value(topic) == payload:
            return Drop.KNOWN
        away = self._transports[side.other].state is not State.CONNECTED
        resolution = self._reconciliation.receive(
            side,
            topic,
            payload,
            retained=retained,
            other_away=away,
            went_back=self._has_gone_back(side),
        )
        if resolution is Resolution.PASS:
            self._on_value(subject, payload)
            return None
        if resolution is Resolution.RESTORE:
            self._publish_value(side, topic, payload)
            self._on_value(subject, payload)
            return None
        if resolution is Resolution.CORRECT:
            self._publish_value(side, topic, self._reconciliation.value(topic) or b"")
        return _DROPS.get(resolution, Drop.OVERRULED)

    def _is_retained(self, side: Side, message: Message) -> bool:
        if not message.retain:
            return False
        if not self._transports[side].as_published:
            return True
        return self._clock() < self._retained_until[side] and not self._reconciliation.has_received(side, message.topic)

    # -- stops, without the lock

    def _is_stop(self, topic: str) -> bool:
        subject = self._subjects[topic]
        return subject is not None and subject.is_stop

    def _is_old_stop(self, side: Side, message: Message) -> bool:
        if not message.retain:
            return False
        return not self._transports[side].as_published or self._clock() < self._stops_retained_until[side]

    def _note_retained(self, side: Side) -> None:
        now, until = self._clock(), self._stops_retained_until[side]
        if now >= until:
            return
        self._retained_at[side] = now
        if until < float("inf"):
            end = self._subscribed_at[side] + _RETAINED_STOPS_S
            self._stops_retained_until[side] = min(max(now + INITIAL_SYNC_S, until), end)

    def _begin_restarted(self) -> None:
        while self._restarted:
            self._reconciliation.begin(self._restarted.pop())

    def _report_value(self, topic: str) -> None:
        subject, payload = self._subjects[topic], self._reconciliation.value(topic)
        if subject is not None and payload is not None:
            self._on_value(subject, payload)

    def _publish_value(self, side: Side, topic: str, payload: bytes) -> None:
        subject = self._subjects[topic]
        if self.gate is Gate.OPEN and subject is not None:
            self._publish(side, subject, Message(topic, payload), Forward(QoS.DELIVERED, True, subject.kind in URGENT))

    # -- sending

    def _publish(self, side: Side, subject: Subject, message: Message, forward: Forward) -> None:
        topic, payload, transport = message.topic, message.payload, self._transports[side]
        if subject.runs or self._cycles.closed_ways:
            self._note_return(side, subject, message)
        echoing = not transport.exact_echo and _echo_matters(subject)
        if echoing:
            self._loopback[side].expect(topic, payload)
        accepted = transport.publish(
            topic,
            payload,
            qos=forward.qos,
            retain=forward.retain,
            urgent=forward.urgent,
            shared=subject.kind in self._both_ways,
        )
        if not accepted:
            self.counters.add(f"{side.value}: refused")
        if echoing and (not accepted or transport.state is not State.CONNECTED):
            self._loopback[side].forget(topic)
        if forward.retain and subject.kind in self._both_ways:
            self._reconciliation.note_published(side, topic, payload)

    def _is_echo(self, side: Side, subject: Subject, message: Message) -> bool:
        circulates = (side, message.topic) in self._cycles.closed_ways
        if circulates and self._returns[side].is_echo(message.topic, message.payload):
            return True
        if self._transports[side].exact_echo or message.retain or not _echo_matters(subject):
            return False
        return self._loopback[side].is_echo(message.topic, message.payload)

    def _echo_is_exact(self, over: Callable[[list[bool]], bool]) -> bool:
        return over([transport.exact_echo for transport in self._transports.values()])

    def _may_mirror(self) -> bool:
        """A broker that sends our own commands back would repeat each one later: also after the stop."""
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
    """Wait, bounded, until the other end of ``transport`` has handled all we sent, and its retained messages are here.

    A subscription is acknowledged after everything before it. ``filter_`` should be within one that is subscribed to
    anyway: a broker may forbid others. A narrow one brings few retained messages.
    """
    transport.subscribe(filter_, _ignore, echo=False, direct=True, limit=1).close()


def _is_json(value: bytes) -> bool:
    """Whether white space may follow ``value`` without changing it."""
    try:
        msgspec.json.decode(codec.trim(value))
    except msgspec.DecodeError:
        return False
    return True


def _ignore(_message: Message) -> None:
    """A barrier has to subscribe to something."""


def _after(subject: Subject) -> int:
    """How many equal messages within 2 s are not suspicious: of what runs something, none that could run it twice.

    Actions are probed at once. Programs of others need to know of probes on those topics already; on those of other
    commands they see one only after a repetition.
    """
    if subject.kind.direction == OUTGOING:
        return STORM
    if subject.kind is Kind.ACTION:
        return 0
    return 1 if subject.runs else SUSPICIOUS


def _is_late(subject: Subject, message: Message, waited_s: float) -> bool:
    """Of what happens once."""
    if waited_s <= (_PATIENT_S if subject.channel in _PATIENT else _LATE_S):
        return False
    return not (subject.is_stop or _ends_something(subject, message))


def _ends_something(subject: Subject, message: Message) -> bool:
    channel = subject.channel
    if channel not in _SWITCHES and channel is not DRIVE:
        return False
    try:
        return codec.ends(codec.decode(channel, message.payload))
    except PayloadError:
        return False


def _echo_matters(subject: Subject) -> bool:
    """Whether it is forwarded both ways even while remote-mirror is off."""
    return subject.kind in (Kind.FLAG, Kind.ACTION)
