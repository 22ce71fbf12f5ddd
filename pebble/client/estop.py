"""Sends an emergency stop until it is confirmed. Pure: the caller publishes, receives and waits.

The robot remembers the stop; the sender repeats it until each motor owner has published that it is stopped.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection
from enum import Enum

from pebble.client.estop_states import RobotEstop
from pebble.contract import AUTONOMY_COMMAND, DRIVE, ESTOP, Channel, codec
from pebble.contract.identity import Direction, parse_topic
from pebble.contract.payloads import AutonomyCommand, Drive, EstopCommand
from pebble.motion.latch import is_name, stop_of
from pebble.transports import Message, QoS

REPEAT_S = 0.5
COLLECT_S = 3.0  # so long a stop of all robots is sent to further ones
GIVE_UP_S = 60.0
MAX_ROBOTS = 1000  # robots beyond are counted, but not stopped: topics may come from other programs

_ZERO = codec.encode(DRIVE, Drive(valid_ms=0))
_END_SCRIPT = codec.encode(AUTONOMY_COMMAND, AutonomyCommand(action="stop"))


def new_name() -> str:
    """The name of a new stop."""
    return secrets.token_hex(8)


class Progress(Enum):
    """How far the stop of one robot is."""

    WAITING = "waiting"
    CONFIRMED = "confirmed"
    OLD = "old"  # it has no emergency stop: zeros are sent while the stop lasts, and it cannot be latched
    SPARED = "spared"  # among all robots: it offers neither driving nor an emergency stop
    NOT_CONFIRMED = "not confirmed"  # it is no longer sent to


class RobotStop:
    """The stop of one robot: what is sent to it when, and whether it is confirmed."""

    def __init__(self, base: str, stop: str, payload: bytes, now: float, *, named: bool, hold: bool) -> None:
        self.estop = RobotEstop(base)
        self.live = False  # anything but retained messages has arrived from it
        self.confirmed_s: float | None = None  # how long it took; None: it is not confirmed
        self.next: float = now  # when to send again, unless it is confirmed or spared
        self._stop, self._payload = stop, payload
        self._named, self._hold = named, hold
        self._began = now
        self._sent_at = float("-inf")
        self._script_ended = False
        self._given_up = False
        self._boots: dict[str, str] = {}  # by owner, the newest one in which it has listed this stop

    @property
    def progress(self) -> Progress:
        """How far its stop is."""
        if self.confirmed_s is not None:
            return Progress.CONFIRMED
        if self.estop.has_capabilities and not (self.estop.available or self.estop.drives or self._named):
            return Progress.SPARED
        if self.estop.old:
            return Progress.OLD
        return Progress.NOT_CONFIRMED if self._given_up else Progress.WAITING

    @property
    def saved(self) -> bool:
        """Whether every owner has saved its state, so that it survives a power cut."""
        states = self.estop.states
        return bool(self.estop.owners) and all(
            owner in states and states[owner].persisted is True for owner in self.estop.owners
        )

    @property
    def unconfirmed(self) -> dict[str, str]:
        """Why, by owner; owners that are confirmed are not in it."""
        return {owner: why for owner in self.estop.owners if (why := self._lacks(owner))}

    @property
    def why(self) -> str:
        """Why it is not confirmed, in words; empty if it is. Names of owners in it come from the robot."""
        if self.progress in (Progress.CONFIRMED, Progress.SPARED):
            return ""
        if self.estop.old:
            return "it has no emergency stop"
        if not self.estop.has_capabilities:
            return "it has not published its capabilities" if self.live else "nothing was received: it may be off"
        if not self.estop.available:
            return "its broker refuses emergency stops, so it gets zeros" if self.estop.drives else "it does not drive"
        if not self.estop.owners:
            return "its capabilities list no valid motor owners"
        why = ", ".join(f"{owner} {why}" for owner, why in self.unconfirmed.items())
        return why if self.live else f"{why}: it may be off"

    @property
    def sending(self) -> bool:
        """Whether the stop is repeated."""
        return not self._given_up and self.progress in (Progress.WAITING, Progress.OLD)

    def receive(self, message: Message, now: float) -> None:
        """Update from a message of this robot."""
        self.live = self.live or not message.retain
        known = self.estop.has_capabilities
        if not self.estop.receive(message):
            return
        if self.estop.has_capabilities and not known:
            self.next = now  # its drive topic may be another one
        self._boots.update(
            {owner: self.estop.states[owner].boot for owner in self.estop.owners if self._lists_it(owner)}
        )
        if self.confirmed_s is None:
            if self.estop.owners and self.estop.available and not self.unconfirmed:
                self.confirmed_s = now - self._began
        elif self._hold and not all(map(self._has_taken_it, self.estop.owners)):
            self.confirmed_s = None  # it has restarted, and saved nothing
            self._began = now
            self.next = max(now, self._sent_at + REPEAT_S)

    def tick(self, now: float) -> list[Message]:
        """What to publish now."""
        if not self.sending or now < self.next:
            return []
        self._sent_at, self.next = now, now + REPEAT_S
        messages = []
        if not self.estop.old:
            messages.append(_message(ESTOP, ESTOP.topic(self.estop.base), self._payload))
        elif not self._script_ended:
            self._script_ended = True
            messages.append(_message(AUTONOMY_COMMAND, self.estop.script_topic, _END_SCRIPT))
        messages.append(_message(DRIVE, self.estop.drive_topic, _ZERO))
        return messages

    def give_up(self) -> None:
        """Send no more."""
        self._given_up = True

    def _lacks(self, owner: str) -> str:
        if not self._lists_it(owner):
            return "has not confirmed"
        return "has not saved it" if self.estop.states[owner].persisted is False else ""

    def _lists_it(self, owner: str) -> bool:
        state = self.estop.states.get(owner)
        return state is not None and self._stop in state.recent

    def _has_taken_it(self, owner: str) -> bool:
        """Whether it has listed this stop since its start: later stops of others may have taken its place."""
        state = self.estop.states.get(owner)
        return state is not None and self._boots.get(owner) == state.boot


class StopSender:
    """One emergency stop, of named robots or of all, until it is confirmed, ended, or 60 s old.

    Publish what ``tick`` returns, pass every message of the robots' ``outgoing/#`` to ``receive``, and call ``tick``
    again after it and at ``due``. Times are seconds of one monotonic clock. A ``hold`` lasts until ``end``.
    """

    def __init__(
        self, name: str, *, by: str, why: str, now: float, robots: Collection[str] | None, hold: bool = False
    ) -> None:
        """``name`` is that of :func:`new_name`; ``robots`` are base topics, None: all robots that publish anything."""
        if not is_name(name):
            raise ValueError(f"{name!r} is not 16 hex digits")
        _, by, why = stop_of({"by": by, "why": why})
        self.name, self.hold = name, hold
        self.robots: dict[str, RobotStop] = {}
        self.omitted = 0  # messages of robots beyond MAX_ROBOTS
        self._payload = codec.encode(ESTOP, EstopCommand(stop=name, by=by, why=why))
        self._named = robots is not None
        self._began = self._now = now
        self._ended = False
        for base in robots or ():
            self._add(base, now)

    @property
    def collecting(self) -> bool:
        """Whether further robots are stopped when they publish anything."""
        return not self._named and not self._ended and (self.hold or self._now < self._began + COLLECT_S)

    @property
    def finished(self) -> bool:
        """Whether nothing more will be sent."""
        return self._ended or not (self.hold or self.collecting or any(robot.sending for robot in self.robots.values()))

    @property
    def confirmed(self) -> bool:
        """Whether at least one robot is stopped, and every other one, except components that do not drive."""
        found = {robot.progress for robot in self.robots.values()}
        return Progress.CONFIRMED in found and found <= {Progress.CONFIRMED, Progress.SPARED} and not self.omitted

    @property
    def due(self) -> float | None:
        """When to call ``tick`` next; None: not before a message."""
        if self.finished:
            return None
        times = [robot.next for robot in self.robots.values() if robot.sending]
        if not self.hold:
            times.append(self._began + (COLLECT_S if self.collecting else GIVE_UP_S))
        return min(times, default=None)

    def receive(self, message: Message, now: float) -> None:
        """Update from any message of a robot, retained or not."""
        self._now = now
        address = parse_topic(message.topic)
        if address is None or address.direction is not Direction.OUTGOING:
            return
        robot = self.robots.get(address.identity.base)
        if robot is None and address.identity.is_server:
            return
        if robot is None and self.collecting and message.payload:  # an empty one removes what was retained
            if len(self.robots) >= MAX_ROBOTS:
                self._make_room(message)
            robot = self._add(address.identity.base, now)
        if robot is not None:
            robot.receive(message, now)

    def tick(self, now: float) -> list[Message]:
        """What to publish now; some of it again in 0.5 s."""
        self._now = now
        if not self.hold and now >= self._began + GIVE_UP_S:
            self.end()
        return [message for robot in self.robots.values() for message in robot.tick(now)]

    def end(self) -> None:
        """Send no more. Robots that are stopped stay so."""
        self._ended = True
        for robot in self.robots.values():
            robot.give_up()

    def _make_room(self, message: Message) -> None:
        """For a robot that is there, forget one of which there are only old retained messages."""
        left = (base for base, robot in self.robots.items() if not (robot.live or robot.estop.has_capabilities))
        if not message.retain and (base := next(left, None)) is not None:
            del self.robots[base]
            self.omitted += 1

    def _add(self, base: str, now: float) -> RobotStop | None:
        if len(self.robots) >= MAX_ROBOTS:
            self.omitted += 1
            return None
        robot = self.robots[base] = RobotStop(base, self.name, self._payload, now, named=self._named, hold=self.hold)
        return robot


def _message(channel: Channel, topic: str, payload: bytes) -> Message:
    return Message(topic, payload, QoS(channel.default_qos))
