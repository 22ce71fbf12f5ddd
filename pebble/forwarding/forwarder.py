"""Forwards messages between a robot's own transport and another one, by a routing table.

The thread that received a message publishes it on the other side, in a bounded time: a drive command never waits for
another thread. All retained messages pass under one lock, because both sides may change the same flag at once; commands
and streams never wait for it.

Retained commands are stale. A live emergency stop passes even if it was published as retained: a stop that does not
arrive is worse than one that a later subscriber must recognise as old. Commands and actions are also stale when they
have waited, in a process that was stopped or stuck, or at the broker; one that only ends something never is.
"""

import itertools
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping

import msgspec
from msgspec import UNSET
from msgspec.structs import replace

from pebble.contract import DRIVE, ESTOP, Kind, codec
from pebble.contract.names import NO_ACCOUNT
from pebble.contract.payloads import SCRIPT, Drive
from pebble.errors import PayloadError
from pebble.forwarding.admission import Admission
from pebble.forwarding.command_ages import STAMP, STAMP_LETTER, CommandAges, ends_something
from pebble.forwarding.cycles import Cycles, Finding
from pebble.forwarding.names import Names, Signed
from pebble.forwarding.observer import Step
from pebble.forwarding.publisher import Publisher
from pebble.forwarding.retained_topics import RetainedTopics
from pebble.forwarding.routing import Drop, Forward, Rules, Side, route
from pebble.forwarding.side import Gate, Sides, SideState
from pebble.forwarding.subjects import Subject, Subjects
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message, QoS, Transport
from pebble.transports.counters import Counters, bounds_reached

log = logging.getLogger(__name__)

_LOGGED = 200  # characters of a topic
_STOP = f"/{ESTOP.metric}".encode()
_SCRIPT, _BACKSLASH = SCRIPT.encode(), 0x5C
_NAMES = (Drop.UNNAMED, Drop.MISNAMED, Drop.UNREADABLE)  # where senders are checked: these are logged
_BOUNDS = (Drop.TOO_LARGE, Drop.TOO_MANY, Drop.TOO_OFTEN, Drop.LATE, Drop.CIRCULATES, Drop.SIGNED, *_NAMES)
_WARNED = (Drop.TOO_LARGE, Drop.TOO_MANY, Drop.TOO_OFTEN)


#: Publishes an admitted message on the other side, or returns why not, as :meth:`Forwarder.pass_now`.
Pass = Callable[[SideState, Subject, Message, Forward, str], Forward | Drop]


class Routed(msgspec.Struct, frozen=True):
    """Result of forwarding a received message; ``subject`` is None for a topic that is not this robot's.

    ``by`` is the sender where names are checked: the topic's account, ``account/person``, or ``-`` (NO_ACCOUNT); for a
    refused message the account alone. It is None elsewhere, and for messages of the robot itself.
    """

    subject: Subject | None
    outcome: Forward | Drop
    by: str | None = None


class Mirroring:
    """State of the flag remote-mirror: while it is on, commands of the robot's own programs are forwarded as well."""

    def __init__(self, sides: Sides) -> None:
        self.on = False
        self._sides, self._was_refused = sides, False

    def switch(self, *, on: bool) -> None:
        self.on = on
        if not on:
            self._was_refused = False  # the next refusal is logged again

    def is_possible(self) -> bool:
        """True if no side sends our own messages back. Otherwise commands would be repeated, even after a stop."""
        if all(state.transport.exact_echo for state in self._sides.values()):  # subscribe(echo=False) is exact
            return True
        if not self._was_refused:  # it is logged once
            self._was_refused = True
            log.error(
                "remote-mirror is refused: a broker sends our own messages back; use one with bridge mode "
                '(mosquitto), or protocol "5" on both sides'
            )
        return False


class Forwarder:
    """A forwarder between two transports.

    Its owner passes on the state of each in :attr:`sides`, subscribes, and has :attr:`retained` synchronized
    INITIAL_SYNC_S after each subscription.
    ``winner`` is the side whose retained messages count where they differ (see .reconciliation).
    ``names`` finds the senders of messages on the remote side, where they are checked.
    ``on_value(subject, payload)`` is called, on any thread and with a lock held, with each new value of a two-way
    retained topic.
    ``pass_stop(side, payload)`` returns the payloads to forward for a stop received on ``side``. ``steps``: functions
    of extensions that may refuse a message, by extension.
    """

    def __init__(
        self,
        subjects: Subjects,
        rules: Rules,
        transports: Mapping[Side, Transport],
        *,
        winner: Side,
        names: Names | None = None,
        on_value: Callable[[Subject, bytes], None] = lambda _subject, _payload: None,
        pass_stop: Callable[[Side, bytes], Iterable[bytes]] = lambda _side, payload: (payload,),
        steps: Mapping[str, Step] = {},
        clock: Callable[[], float],
    ) -> None:
        self.counters, self._steps = Counters(), steps
        self.stays: Callable[[str], bool] = lambda _topic: False  # True for topics obeyed only inside the robot
        self.subjects, self._rules, self._names = subjects, rules, names
        self._pass_stop = pass_stop
        self.sides = Sides(
            (side, SideState(side, transport, self.counters, clock, wins=side is winner))
            for side, transport in transports.items()
        )
        #: Results of :func:`route` by its arguments, see _route. There are few subjects, so no bound is needed.
        self._routes: dict[tuple[Side, Subject, QoS, bool, bool | None, bool], Forward | Drop] = {}
        self._admission = Admission(clock)  # limits of size and number
        self.ages = CommandAges()  # of commands, by the clocks of their senders
        self.cycles = Cycles(clock)  # messages that something else brings back
        both_ways = frozenset(kind for kind in Kind if rules.both_ways(kind))
        self.publisher = Publisher(self.sides, self.cycles, subjects, self.counters, both_ways, stored=rules.stored)
        self.retained = RetainedTopics(self.sides, subjects, self.publisher, winner, both_ways, on_value)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self.mirroring = Mirroring(self.sides)
        #: Publishes an admitted message at once; an extension may replace it by a function that lets some of them wait.
        self.pass_on: Pass = self.pass_now
        #: Is told whether each drive command, and request for control, from outside was late.
        self.note_age: Callable[[bool], None] = lambda _late: None
        for transport in transports.values():
            transport.policy.is_stop = self._is_stop

    @property
    def gate(self) -> Gate:
        return self.sides.gate

    def dropped(self) -> dict[str, int]:
        """Return how many messages did not pass because of a bound, here or in a transport, by reason."""
        counts = Counter(bounds_reached(*(state.transport.counters for state in self.sides.values())))
        for drop, side in itertools.product(_BOUNDS, Side):
            counts[drop.name.lower()] += self.counters[f"{side.value}: {drop.value}"]
        counts["events"] = self.counters["events_dropped"]
        if shed := self.counters["shed"]:  # counted by an extension, on thin links
            counts["shed"] = shed
        return dict(counts)

    # -- connections

    def subscribed(self, side: Side) -> None:
        """Note that ``side`` is connected and subscribed, and that its retained messages have arrived."""
        self.sides[side].window.subscribed()
        if self.gate is Gate.OPEN:
            self.sides[side].events.flush()

    def open(self) -> None:
        """Start forwarding, with the messages that have waited."""
        self.retained.open()
        for state in self.sides.values():
            state.events.flush()

    def shut(self) -> None:
        """Stop forwarding. Takes no lock: a loop of messages must end at once."""
        self.retained.shut()
        for state in self.sides.values():
            state.events.clear()

    def rearm(self) -> None:
        """Undo :meth:`shut`: messages wait for :meth:`open`, and the remote side must be synchronized again."""
        if self.gate is Gate.SHUT:
            self.sides[Side.REMOTE].subscribing()
            self.sides[Side.REMOTE].restarted = True
            self.sides.gate = Gate.WAITING

    # -- the receiving threads

    def skips_retained(self, side: Side, topic: bytes) -> bool:
        """True if a retained message of ``topic`` does not pass: then it is counted and logged. For TopicPolicy."""
        if self._names is not None and topic.endswith(_STOP) and self._is_stop(topic.decode(errors="replace")):
            return False  # it may be a live stop, with a name in its topic
        kind = self.subjects.invented(topic)  # FLAG or COMMAND if the contract does not know the topic; else None
        if kind is None or (kind is Kind.FLAG and not self._admission.refuses_flag(topic)):
            return False  # the contract knows it, or it is an unknown flag for which there is room
        drop = Drop.TOO_MANY if kind is Kind.FLAG else Drop.STALE  # a retained command
        self.sides[side].window.note()  # while retained messages come, a stop may be an old one
        self.counters.add(f"{side.value}: {drop.value}")
        self._warn(drop, topic[:_LOGGED].decode(errors="replace"))
        return True

    def receive(self, side: Side, message: Message) -> Routed:
        source = self.sides[side]
        if self._names is not None and side is Side.REMOTE:
            routed = self._receive_named(source, self._names, message)
        else:
            subject = self.subjects[message.topic]
            outcome = self.admit(source, subject, message, message.topic, True)  # True: no name is needed
            if subject is not None and isinstance(outcome, Forward):
                outcome = self.pass_on(source, subject, message, outcome, "")
            routed = Routed(subject, outcome)
        if isinstance(routed.outcome, Drop):
            self.counters.add(f"{side.value}: {routed.outcome.value}")
        else:
            source.count_forwarded()
        return routed

    def _receive_named(self, source: SideState, names: Names, message: Message) -> Routed:
        """Forward a message whose sender is checked: the name moves from the topic into the payload."""
        sender = names[message.topic]
        subject, by = sender.subject, sender.account  # by: later as in Signed, with the person behind the account
        outcome = self.admit(source, subject, message, sender.topic, by != NO_ACCOUNT)  # notes foreign retained ones
        if subject is None:
            outcome = sender.foreign  # why the topic means nothing to this robot
        elif isinstance(outcome, Forward):
            match names.sign(sender, message):
                case Signed(signed, by) if by != NO_ACCOUNT and subject.kind is Kind.FLAG:
                    outcome = self.retained.change(subject, signed)  # the topic without a name gets it on both sides
                case Signed(signed, by):
                    outcome = self.pass_on(source, subject, signed, outcome, sender.account)
                case Drop.UNNAMED if outcome.retain:  # retained: perhaps the robot's own, as the remote broker has it
                    outcome = self.retained.receive(source, subject, message, outcome, only_old=True)
                case Drop() as drop:
                    outcome = drop
        if isinstance(outcome, Drop) and outcome in _NAMES:
            self._warn(outcome, message.topic[:_LOGGED])
        return Routed(subject, outcome, by)

    def admit(
        self, source: SideState, subject: Subject | None, message: Message, topic: str, named: bool
    ) -> Forward | Drop:
        """Return how to forward ``message``, or why it does not pass. Must be fast.

        ``topic`` is the topic on the other side. ``named``: the sender has an account, or needs none.
        """
        if subject is not None and subject.is_stop:
            if not source.window.is_old_stop(message):
                message = Message(message.topic, message.payload, message.qos)  # live: passes, and is retained nowhere
        elif message.retain:
            source.window.note()  # while such messages arrive, a stop among them is an old one
        if subject is None:
            return Drop.FOREIGN
        forward = self._route(source.side, subject, message)
        if isinstance(forward, Drop):
            return forward
        # A message beyond a bound is neither compared with what we have sent nor examined for cycles, an echo is no
        # cycle, and extensions are asked last.
        return (
            self._beyond_bound(source, subject, message, topic, named)
            or self._echo(source, subject, message)
            or self._cycle(source, subject, message, forward)
            or self._refused_by_step(source, subject, message)
            or forward
        )

    def _route(self, side: Side, subject: Subject, message: Message) -> Forward | Drop:
        """Return the result of :func:`route`, which is computed once per kind of message."""
        mirroring = self.mirroring.on and self.mirroring.is_possible()
        key = side, subject, message.qos, message.retain, message.retain_requested, mirroring
        forward = self._routes.get(key)
        if forward is None:
            forward = self._routes[key] = route(self._rules, side, subject, message, mirroring=mirroring)
        return forward

    def _beyond_bound(
        self, source: SideState, subject: Subject, message: Message, topic: str, named: bool
    ) -> Drop | None:
        drop = self._admission.refuse(source.side, subject, message, topic, named=named)
        if drop in _WARNED:
            self._warn(drop, message.topic[:_LOGGED])
        return drop

    def _echo(self, source: SideState, subject: Subject, message: Message) -> Drop | None:
        if not self.cycles.closed_ways and source.transport.exact_echo:
            return None
        return Drop.ECHO if self.publisher.is_echo(source, subject, message) else None

    def _cycle(self, source: SideState, subject: Subject, message: Message, forward: Forward) -> Drop | None:
        if self.sides.gate is not Gate.OPEN:
            return None
        finding = self.cycles.examine(source.side, subject, message)
        return None if finding is Finding.PASS else self._act_on(finding, source.side, subject, message, forward)

    def _refused_by_step(self, source: SideState, subject: Subject, message: Message) -> Drop | None:
        if subject.is_stop:
            return None
        for name, step in self._steps.items():
            try:
                why = step(source.side, subject, message)
            except Exception as error:  # noqa: BLE001 - whatever foreign code raises: it is no refusal
                self._quiet_log.warning(name, "the extension %s failed at %s: %r", name, message.topic[:_LOGGED], error)
                continue
            if why:
                self._quiet_log.warning(name, "%s is not forwarded: %s: %s", message.topic[:_LOGGED], name, why)
                return Drop.REFUSED
        return None

    def pass_now(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, account: str = ""
    ) -> Forward | Drop:
        """Publish an admitted message on the other side, or return why not. Must be fast.

        ``account`` is the account of the sender, where names are checked.
        """
        passing = self.examine(source, subject, message, forward, account)
        if isinstance(passing, Drop):
            return passing
        if forward.retain:
            return self.retained.receive(source, subject, passing, forward)
        return self.deliver(source, subject, passing, forward)

    def examine(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, account: str
    ) -> Message | Drop:
        """Return an admitted message as it may pass, or why not: it is too late, or a script elsewhere sent it."""
        if subject.kind.one_shot and self._is_late(subject, message, forward, account):
            return Drop.LATE
        if not forward.unsigned:  # a command may also pass with a script's signature
            return message
        return self._without_script(source, message) or Drop.SIGNED  # SIGNED: a script elsewhere would move the robot

    def _is_late(self, subject: Subject, message: Message, forward: Forward, account: str) -> bool:
        """True if a command or action has waited for too long, unless it only ends something."""
        tells_age = forward.stamped and STAMP_LETTER in message.payload and STAMP in message.payload
        waited_s = self.ages.waited_s(subject, message, account) if tells_age else message.waited_s
        late = waited_s > subject.waits_s and not ends_something(subject, message)
        # Many late commands show a flood, but not those that tell their age: their senders keep to the link's pace.
        if forward.stamped and not (late and tells_age):
            self.note_age(late)
        return late

    def _without_script(self, source: SideState, message: Message) -> Message | None:
        """Return a drive command without a script's signature; None if a script's command would move the robot."""
        passing = unsigned(message.payload)
        if passing is message.payload:  # it has no signature
            return message
        self._quiet_log.warning(Drop.SIGNED.name, "%s: %s", message.topic[:_LOGGED], Drop.SIGNED.value)
        if passing is None:
            return None
        self.counters.add(f"{source.side.value}: zeros of a script, passed as a person's")
        return Message(message.topic, passing, message.qos)

    def deliver(self, source: SideState, subject: Subject, message: Message, forward: Forward) -> Forward | Drop:
        """Publish a message that is not retained, if the :class:`Gate` is OPEN. While it is WAITING, hold an event."""
        target = self.sides[source.side.other]
        is_event = subject.kind is Kind.EVENT and message.qos is QoS.DELIVERED
        if self.sides.gate is not Gate.OPEN:
            return self._hold_event(target, message) if is_event else Drop.CLOSED
        if subject.is_stop:
            payloads = list(self._pass_stop(source.side, message.payload))
            for payload in payloads:
                self.publisher.publish(target, subject, Message(message.topic, payload, message.qos), forward)
            return forward if payloads else Drop.RESET  # none: it was reset since, or is a copy that a mirror keeps
        if is_event:
            self.publisher.note_return(target, subject, message)
            target.events.send(message)
        else:
            self.publisher.publish(target, subject, message, forward)
        return forward

    def _act_on(
        self, finding: Finding, side: Side, subject: Subject, message: Message, forward: Forward
    ) -> Drop | None:
        """Carry out a finding about cycles; return why the message does not pass, None if it does."""
        match finding:
            case Finding.CIRCULATES:
                return Drop.CIRCULATES
            case Finding.SUSPECT:  # the probe goes first: it comes back before the message does
                self.publisher.probe(side, message.topic, message.payload)
                return None
            case Finding.RELAY:  # another bridge's probe
                relayed = Forward(forward.qos, False, forward.urgent)  # False: not retained
                self.publisher.publish(self.sides[side.other], subject, message, relayed)
        return Drop.PROBE  # Finding.PROBE: ours, or forwarded before; after RELAY: published just now

    def _hold_event(self, target: SideState, message: Message) -> Drop:
        if self.gate is Gate.SHUT:
            return Drop.CLOSED
        target.events.hold(message)
        gate = self.sides.gate  # read again: it may have been opened or shut just before this event was held
        if gate is Gate.OPEN:
            target.events.resume()
        elif gate is Gate.SHUT:
            target.events.clear()
        return Drop.HELD

    def _is_stop(self, topic: str) -> bool:
        subject = self.subjects[topic] if self._names is None else self._names[topic].subject
        return subject is not None and subject.is_stop

    def _warn(self, drop: Drop, topic: str) -> None:
        self._quiet_log.warning(drop.name, "%s is not forwarded: %s", topic, drop.value)


def unsigned(payload: bytes) -> bytes | None:
    """Return a drive command without a script's signature, or the same object if it has none; None: it must not pass.

    A signature names the script run that may drive, so it counts only if a program on the robot sends it. A signed
    command from outside does not pass if it moves anything. A signed zero passes as a person's, and stops the motors.

    Must be fast: a person's command is rarely decoded. JSON may spell SCRIPT, a script's source, with backslashes. A
    payload with SCRIPT or a backslash that cannot be decoded does not pass: a board's parser may be more lenient.
    """
    if _BACKSLASH not in payload and _SCRIPT not in payload:
        return payload
    try:
        drive: Drive = codec.decode(DRIVE, payload)
    except PayloadError:
        return None
    if not drive.signed:
        return payload
    return None if drive.moves else codec.encode(DRIVE, replace(drive, source=UNSET, run=UNSET))


def barrier(transport: Transport, filter_: str) -> None:
    """Wait, for a limited time, until the other end has handled our messages and its retained messages have arrived.

    A subscription is acknowledged after everything sent before it. ``filter_`` should lie within a filter that is
    subscribed to anyway, because a broker may forbid others. A narrow filter brings few retained messages.
    """
    transport.subscribe(filter_, _ignore, echo=False, direct=True, limit=1).close()


def _ignore(_message: Message) -> None:
    """Do nothing: :func:`barrier` subscribes only to wait for the acknowledgement."""
