"""The sender of an emergency stop, until it is confirmed and saved. Pure: the caller publishes, receives and waits.

*Confirmed*: each motor owner has published that this stop holds it. *Saved*: the owner would also be stopped after a
power cut. The sender repeats the stop until both hold, or until an owner says that it cannot save.
"""

import json
import secrets
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

from pebble.contract import AUTONOMY_COMMAND, DRIVE, ESTOP, INCOMING, ONLINE, OUTGOING, STATUS, Channel, codec
from pebble.contract.identity import parse_topic
from pebble.contract.levels import silent_after
from pebble.contract.payloads import AutonomyCommand, Drive, EstopCommand
from pebble.errors import PayloadError
from pebble.extensions.operator.client.driveable import Driveable, driveable_of
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.stamps import stamp_of
from pebble.motion.latch import is_name, stop_of
from pebble.transports import Message, QoS

REPEAT_S = 0.5
COLLECT_S = silent_after(link="thin")  # so long a stop of all is sent to further robots, which may be at any level
GIVE_UP_S = 60.0
MAX_ROBOTS = 2000  # to which a stop of all is repeated; one beyond gets it whenever anything arrives from it
_STAMPED_BYTES = 64 * 1024  # of a message whose stamp is read

_ZERO = codec.encode(DRIVE, Drive(valid_ms=0))
_ZEROS = "it has motors that no stop can hold: they get zeros"
_END_SCRIPT = codec.encode(AUTONOMY_COMMAND, AutonomyCommand(action="stop"))


def new_name() -> str:
    return secrets.token_hex(8)


class Progress(Enum):
    """The progress of one robot's stop, in the words of the pages."""

    WAITING = "sent"
    CONFIRMED = "confirmed"
    OLD = "old"  # it has no emergency stop: zeros are sent while the stop lasts, and it cannot be latched
    SPARED = "spared"  # among all robots: it says that it does not drive; it gets the stop once, and is not waited for
    NOT_CONFIRMED = "not confirmed"  # it is no longer sent to


class Order(NamedTuple):
    """The part of a stop that is the same for all robots."""

    name: str
    payload: bytes
    named: bool  # it is for the robots that its sender names; False: for all that publish anything
    hold: bool  # it lasts until it is ended
    own_only: bool  # topics that a robot's capabilities name are used only if they are incoming ones of its own


class RobotStop:
    """The stop of one robot: the time of its next message, and whether it is confirmed."""

    def __init__(self, base: str, order: Order, now: float) -> None:
        self.estop = RobotEstop(base)
        self.live = False  # anything but retained messages has arrived from it
        self.driveable: Driveable | None = None  # as its status says
        self.confirmed_s: float | None = None  # how long it took; None: it is not confirmed
        self.next: float = now  # when to send again, while :attr:`sending`
        self._order, self._began = order, now
        self._sent_at = float("-inf")
        self._script_ended = False  # the end of a script was sent
        self._given_up = False
        self._names_due = False  # to be sent again: newer capabilities say that topics name the sender
        self._status_topic, self._online_topic = STATUS.topic(base), ONLINE.topic(base)
        self._is_offline = False  # as the newest retained heartbeat says
        self.stamp = 0.0  # the newest stamp of the messages that its broker retains, in epoch seconds
        self._boots: dict[str, str] = {}  # by owner: its ``boot`` when its state listed this stop last
        self._settled = False  # each owner has saved the stop, cannot save anything, or was reset since

    @property
    def progress(self) -> Progress:
        """Return how far the robot's stop has got; SPARED only if the stop is for all robots, not for named ones."""
        if self.confirmed_s is not None:
            return Progress.CONFIRMED
        # SPARED: in a stop of all robots (not ``named``) one that, by its capabilities, neither obeys stops nor drives.
        if self.estop.has_capabilities and not (self.estop.available or self.estop.drives or self._order.named):
            return Progress.SPARED
        if self.estop.old:
            return Progress.OLD
        return Progress.NOT_CONFIRMED if self._given_up else Progress.WAITING

    @property
    def is_gone(self) -> bool:
        """True if the robot is offline, and left only retained messages at its broker."""
        return self._is_offline and not self.live

    @property
    def saved(self) -> bool:
        """True if every owner has saved its newest state, so that it survives a power cut."""
        states = self.estop.states
        return bool(self.estop.owners) and all(
            owner in states and states[owner].persisted is True for owner in self.estop.owners
        )

    @property
    def unconfirmed(self) -> list[str]:
        """Return the owners that have not confirmed."""
        return [owner for owner in self.estop.owners if not self._has_taken_it(owner)]

    @property
    def why(self) -> str:
        """Return why the stop is not confirmed, in words; empty if it is. The owners' names come from the robot.

        For ``old``, ``available``, ``drives`` and ``zeros`` see RobotEstop. A robot may have both owners and zeros.
        """
        if self.progress in (Progress.CONFIRMED, Progress.SPARED):
            return ""
        if self.estop.old:
            return "it has no emergency stop"
        if not self.estop.has_capabilities:
            return "it has not published its capabilities" if self.live else "nothing was received: it may be off"
        if not self.estop.available:
            if self.estop.zeros:  # topics of motors to which a stop sends zeros
                return _ZEROS
            return "its broker refuses emergency stops, so it gets zeros" if self.estop.drives else "it does not drive"
        if not self.estop.owners:
            return "its capabilities list no valid motor owners"
        reasons = [f"{owner} has not confirmed" for owner in self.unconfirmed]
        if self.estop.zeros:
            reasons.append(_ZEROS)
        why = ", ".join(reasons)
        return why if self.live else f"{why}: it may be off"

    @property
    def sending(self) -> bool:
        """True if the stop is still being repeated."""
        unsent = self._names_due or self._sent_at == float("-inf")
        unsaved = self.progress is Progress.CONFIRMED and not self._settled
        unconfirmed = self.progress in (Progress.WAITING, Progress.OLD)
        return not self._given_up and (unsent or unsaved or unconfirmed)

    def receive(self, message: Message, now: float) -> None:
        """Update from a message of this robot, retained or not."""
        if not message.retain and message.payload.strip():  # with an empty message others may remove a retained one
            self.live = True
        if message.retain and len(message.payload) <= _STAMPED_BYTES:
            self._take_retained(message)
        if message.topic == self._status_topic:
            self.driveable = driveable_of(message.payload)
            return
        had_capabilities = self.estop.has_capabilities
        if not self.estop.receive(message):
            return
        if self.estop.has_capabilities and not had_capabilities:
            self.next, self._names_due = now, self.estop.named  # send at once: they may name other topics
        for owner in self.estop.owners:
            if self._lists_it(owner):
                self._boots[owner] = self.estop.states[owner].boot
        self._update_progress(now)

    def _update_progress(self, now: float) -> None:
        """Note whether the robot's owners hold the stop now, and whether they would after a power cut."""
        if self.confirmed_s is None:
            can_hold_all = self.estop.owners and self.estop.available and not self.estop.zeros  # zeros: see RobotEstop
            if can_hold_all and not self.unconfirmed:
                self.confirmed_s = now - self._began
        elif self.unconfirmed and (self._order.hold or not self._settled):
            # an owner has restarted, and the stop is held or was not saved: it is sent again
            self.confirmed_s, self._settled = None, False
            if self._order.hold:  # it may be hours old: count how long this confirmation takes
                self._began = now
            self.next = max(now, self._sent_at + REPEAT_S)
        if self.confirmed_s is not None and not self._settled:
            self._settled = all(map(self._survives, self.estop.owners))  # no save is awaited any more

    def _take_retained(self, message: Message) -> None:
        with suppress(PayloadError, ValueError, RecursionError):
            self.stamp = max(self.stamp, stamp_of(json.loads(message.payload)) or 0.0)
            if message.topic == self._online_topic:
                self._is_offline = codec.decode(ONLINE, message.payload).online is False

    def tick(self, now: float, *, again: bool = True) -> list[Message]:
        """Return the messages to publish now. ``again`` False: only if the robot was sent nothing yet."""
        was_sent = self._sent_at > float("-inf")
        if now < self.next or not self.sending or (was_sent and not again):
            return []
        self._sent_at, self.next, self._names_due = now, now + REPEAT_S, False
        estop, messages = self.estop, []
        if not estop.old:  # old: it is known to have no emergency stop
            messages.append(_message(ESTOP, ESTOP.topic(estop.base), self._order.payload))
        cannot_latch = estop.old or bool(estop.zeros)
        if cannot_latch and not self._script_ended:  # else the script would drive on between two zeros
            self._script_ended = True
            messages.append(_message(AUTONOMY_COMMAND, estop.script_topic, _END_SCRIPT))
        # every robot gets zeros: it may have no emergency stop, or its broker may refuse it
        drive_topics = dict.fromkeys((estop.drive_topic, *estop.zeros))
        messages += [_message(DRIVE, topic, _ZERO) for topic in drive_topics]
        if self._order.own_only:  # capabilities may name what is no command to this robot
            return [message for message in messages if _is_incoming(message.topic, self.estop.base)]
        return messages

    def give_up(self) -> None:
        """Stop sending to this robot."""
        self._given_up = True

    def _survives(self, owner: str) -> bool:
        """True if no save is awaited: the owner has saved the stop, was reset since, or cannot save anything."""
        state = self.estop.states.get(owner)
        return state is not None and (state.persisted is not False or not state.latched)

    def _lists_it(self, owner: str) -> bool:
        state = self.estop.states.get(owner)
        return state is not None and self._order.name in state.recent

    def _has_taken_it(self, owner: str) -> bool:
        """True if the owner has listed this stop and not restarted since, even if it now lists only later stops."""
        state = self.estop.states.get(owner)
        return state is not None and self._boots.get(owner) == state.boot


class StopSender:
    """An emergency stop, of named robots or of all, until it is confirmed, ended, or 60 s old.

    Publish what ``tick`` returns, pass every message of the robots' ``outgoing/#`` to ``receive``, and call ``tick``
    again afterwards and at ``due``. Times are seconds of one monotonic clock. With ``hold`` it never gets too old.

    A stop of all robots is sent to each robot that publishes anything. To those in ``robots`` it is repeated until they
    confirm it. ``omitted`` counts messages of robots for which ``robots`` has no room.
    """

    def __init__(
        self,
        name: str,
        *,
        by: str,
        why: str,
        now: float,
        robots: Collection[str] | None,
        known: Collection[str] = (),
        hold: bool = False,
        own_only: bool = False,
    ) -> None:
        """Prepare the stop. ``name``: of :func:`new_name`; ``robots``: base topics, None: all that publish anything.

        ``known``: in a stop of all, robots that get it even if they publish nothing. ``known`` and ``robots`` may be
        more than MAX_ROBOTS. ``own_only``: as in :class:`Order`.
        """
        if not is_name(name):
            raise ValueError(f"{name!r} is not 16 hex digits")
        _, by, why = stop_of({"by": by, "why": why})  # as motor owners read them: short printable ASCII
        payload = codec.encode(ESTOP, EstopCommand(stop=name, by=by, why=why))
        self.order = Order(name, payload, named=robots is not None, hold=hold, own_only=own_only)
        self.robots = {base: RobotStop(base, self.order, now) for base in (known if robots is None else robots)}
        self.omitted = 0  # messages of robots for which ``robots`` had no room
        self._began = self._now = now
        self._ended = False
        self._overflow: set[str] = set()  # robots for which ``robots`` has no room, and that got the stop
        self._overflow_at = float("-inf")  # when that set was emptied last, so that they get the stop again
        self._overflow_out: list[Message] = []  # stops of such robots, to be sent now

    @property
    def collecting(self) -> bool:
        """True if more robots will be stopped when they publish something."""
        if self.order.named or self._ended:
            return False
        return self.order.hold or self._now < self._began + self._collect_s

    @property
    def finished(self) -> bool:
        """True if nothing more will be sent."""
        if self._ended:
            return True
        return not (self.order.hold or self.collecting or any(robot.sending for robot in self.robots.values()))

    @property
    def confirmed(self) -> bool:
        """True if at least one robot is stopped, and so are all others, except components that do not drive."""
        progress = {robot.progress for robot in self.robots.values()}
        return Progress.CONFIRMED in progress and progress <= {Progress.CONFIRMED, Progress.SPARED} and not self.omitted

    @property
    def due(self) -> float | None:
        """Return when to call ``tick`` next; None: only after a message."""
        if self.finished:
            return None
        times = [robot.next for robot in self.robots.values() if robot.sending]
        if not self.order.hold:
            times.append(self._began + (self._collect_s if self.collecting else GIVE_UP_S))
        return self._now if self._overflow_out else min(times, default=None)

    def receive(self, message: Message, now: float) -> None:
        """Update from a message of a robot, retained or not."""
        self._now = now
        address = parse_topic(message.topic)
        if address is None or address.direction != OUTGOING:
            return
        base = address.identity.base
        is_sign_of_robot = message.payload and not address.identity.is_server  # empty: it removes a retained one
        if base in self.robots:
            self.robots[base].receive(message, now)
        elif self.collecting and is_sign_of_robot:
            self._receive_first(base, message, now)

    def tick(self, now: float, *, again: bool = True) -> list[Message]:
        """Return the messages to publish now; some are repeated after 0.5 s.

        ``again`` False: only to robots that did not get the stop yet, because earlier messages still wait.
        """
        self._now = now
        if not self.order.hold and now >= self._began + GIVE_UP_S:
            self.end()
        messages: list[Message] = []
        for robot in self.robots.values():
            messages += robot.tick(now, again=again)
        return messages + self._take_overflow()

    def tick_robot(self, base: str, now: float, *, again: bool = True) -> list[Message]:
        """Return the messages of ``tick`` for this robot alone, after a message from it."""
        robot = self.robots.get(base)
        messages = [] if robot is None else robot.tick(now, again=again)
        return messages + self._take_overflow()

    def end(self) -> None:
        """Stop sending. Stopped robots stay stopped."""
        self._ended = True
        self._overflow_out.clear()
        for robot in self.robots.values():
            robot.give_up()

    @property
    def _collect_s(self) -> float:
        """Return for how many seconds robots not heard before are stopped: more if ``robots`` has no room for some."""
        return GIVE_UP_S if self.omitted else COLLECT_S

    def _take_overflow(self) -> list[Message]:
        messages, self._overflow_out = self._overflow_out, []
        return messages

    def _receive_first(self, base: str, message: Message, now: float) -> None:
        """Send the stop to a robot that is not in ``robots``, and add it there.

        If there is no room, it gets the stop once in each period of REPEAT_S in which it publishes anything.
        """
        robot = RobotStop(base, self.order, now)
        robot.receive(message, now)
        if len(self.robots) < MAX_ROBOTS:
            self.robots[base] = robot
            return
        self.omitted += 1
        if now >= self._overflow_at + REPEAT_S:
            self._overflow, self._overflow_at = set(), now
        if base not in self._overflow:
            self._overflow.add(base)
            self._overflow_out += robot.tick(now)


def send(publish: Callable[..., bool], messages: Iterable[Message]) -> None:
    """Publish the messages of a stop.

    If the transport refuses them because too many wait, they are published again without acknowledgement (LATEST).
    """
    for message in messages:
        if not publish(message.topic, message.payload, qos=message.qos):
            publish(message.topic, message.payload, qos=QoS.LATEST)


def _is_incoming(topic: str, base: str) -> bool:
    """True for any incoming topic of the robot.

    Publishing a stop there does no harm, and it may be the topic that drives this robot.
    """
    return topic.startswith(f"{base}/{INCOMING}/") and not topic.endswith("/")


def _message(channel: Channel, topic: str, payload: bytes) -> Message:
    return Message(topic, payload, QoS(channel.default_qos))
