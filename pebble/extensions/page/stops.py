"""The emergency stops that pages have sent: repeated until they are confirmed, and shown to pages. Pure.

The robot keeps the stop; see docs/emergency-stop.md.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from pebble.contract.identity import parse_topic
from pebble.contract.payloads import EstopState
from pebble.extensions.operator.client.estop import COLLECT_S, Progress, RobotStop, StopSender
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.transports import Message

log = logging.getLogger(__name__)

MAX_STOPS = 2000  # that are repeated and confirmed at once: one of each robot
_SHOWN_S = 60.0  # so long pages see how a finished stop ended


class RobotsOfStop(NamedTuple):
    """The robots to which a stop is sent. Those without motors count as confirmed."""

    confirmed: list[str]
    unconfirmed: list[str]


@dataclass(slots=True, eq=False)
class _PressedStop:
    """A stop that a page has sent, of one robot or of all."""

    sender: StopSender
    ref: str  # the robot; "": all
    user: str | None  # who has pressed it and may end it; None: several people have, one after another, and none may
    pressed_at: float
    is_over: bool = False  # it sends nothing more. Noted, as to ask a thousand robots at each heartbeat is slow

    @property
    def name(self) -> str:
        return self.sender.order.name


class Stops:
    """The stops of a server. Publish what its methods return, and pass robots' messages to ``receive``."""

    def __init__(self, may_repeat: Callable[[], bool] = lambda: True) -> None:
        """Make an empty table. ``may_repeat`` returns False while sent messages still wait, so that none is repeated.

        It is asked once in each ``tick``.
        """
        self._may_repeat, self._repeats = may_repeat, True  # its answer in the newest tick
        self.changed: set[str] = set()  # robots whose view may be another one now
        self._stops: dict[str, _PressedStop] = {}  # by name, the newest last
        self._by_ref: dict[str, _PressedStop] = {}  # the same stops by robot; "": the one of all
        self._crowded_at = float("-inf")  # when a stop was last ended for lack of room
        self._shown: dict[str, tuple[str, str]] = {}  # by robot: progress and words, as pages see them

    def press(
        self,
        ref: str,
        name: str,
        *,
        by: str,
        why: str,
        now: float,
        known: Iterable[RobotView],
        user: str = "",
    ) -> list[Message]:
        """Stop one robot, or all if ``ref`` is "", in place of an earlier stop of the same robots.

        ``known`` are the robots from which messages were received. ``user`` presses it, and may end it.
        """
        if name in self._stops:
            return []
        robots = [robot for robot in known if ref in ("", robot.base)]
        named, bases = [ref] if ref else None, [robot.base for robot in robots]  # named None: all that publish
        # own_only: what a robot's capabilities say cannot lead its stop to topics of others, see Order.
        sender = StopSender(name, by=by, why=why, now=now, robots=named, known=bases, own_only=True)
        older = self._by_ref.get(ref)
        # A stop that others have pressed, too, has no user: none of them may end it.
        pressed_by_others = older is not None and not older.is_over and older.user != user
        if older is not None:
            self._remove(older)
        self._make_room(now)
        stop = _PressedStop(sender, ref, None if pressed_by_others else user, now)
        self._stops[name] = self._by_ref[ref] = stop
        for robot in robots:
            for message in robot.remembered.values():
                sender.receive(message, now)
        self.changed |= set(sender.robots)
        return self.tick(now)

    def end(self, name: str) -> None:
        """Stop repeating this stop."""
        if name in self._stops:
            sender = self._stops[name].sender
            sender.end()
            self.changed |= set(sender.robots)

    def robots_of(self, name: str) -> RobotsOfStop:
        """Return the robots of this stop; none if it is unknown, or was over long ago."""
        robots = RobotsOfStop([], [])
        if name in self._stops:
            for ref, stop in self._stops[name].sender.robots.items():
                if stop.progress in (Progress.CONFIRMED, Progress.SPARED):
                    robots.confirmed.append(ref)
                else:
                    robots.unconfirmed.append(ref)
        return robots

    def user(self, name: str) -> str | None:
        """Return the user of this stop; None if it is unknown here, or has several users."""
        return self._stops[name].user if name in self._stops else None

    def has_stop_of(self, ref: str) -> bool:
        """True if there is a stop of this robot alone."""
        return ref in self._by_ref

    def sends_to(self, ref: str) -> bool:
        """True if any stop is sent to this robot and awaits its answer, be it a stop of all."""
        return any(ref in stop.sender.robots for stop in self._stops.values())

    def holds(self, ref: str) -> bool:
        """True if a stop is being repeated to a robot that cannot latch it: a drive command would end it."""
        stop = self._newest(ref)[1]
        return stop is not None and stop.sending and not stop.estop.available

    @property
    def collecting(self) -> bool:
        """True if a stop of all is still sent to newly heard robots."""
        return "" in self._by_ref and self._by_ref[""].sender.collecting

    def omitted(self, now: float) -> bool:
        """True if there was no room to await the confirmation of some stopped robots."""
        return now - self._crowded_at < _SHOWN_S or any(stop.sender.omitted for stop in self._stops.values())

    def receive(self, message: Message, now: float) -> list[Message]:
        """Handle a robot's message; return the messages to publish to it now."""
        address = parse_topic(message.topic)
        if address is None:
            return []
        ref, messages = address.identity.base, []
        for stop in [self._by_ref[key] for key in (ref, "") if key in self._by_ref]:
            if not stop.is_over or now - stop.pressed_at < COLLECT_S:  # an ended stop may yet be confirmed
                stop.sender.receive(message, now)
                messages += stop.sender.tick_robot(ref, now, again=self._repeats)  # False: only a first message
                self._note_progress(stop, ref)
        return messages

    def tick(self, now: float) -> list[Message]:
        """Return the messages to publish now; call it every 50 ms."""
        messages, self._repeats = [], self._may_repeat()
        for stop in list(self._stops.values()):
            if not stop.is_over:
                messages += stop.sender.tick(now, again=self._repeats)
                if stop.sender.finished:  # perhaps by time alone; `receive` notes what robots' messages show
                    stop.is_over = True
                    for ref in stop.sender.robots:
                        self._note_progress(stop, ref)
            if stop.is_over and now - stop.pressed_at > _SHOWN_S:
                self._remove(stop)
        return messages

    def view(self, estop: RobotEstop) -> m.EstopView:
        """Return the emergency stop of one component in the form for pages."""
        name, stop = self._newest(estop.base)
        sending, text = ("", "") if stop is None else _progress(stop)
        self._shown[estop.base] = sending, text
        newest = estop.stopped_by
        return m.EstopView(
            available=estop.available,
            latched=bool(estop.latched),
            by="" if newest is None else newest.by,
            why="" if newest is None else newest.why,
            since=0 if newest is None else newest.since,
            owners=tuple(_owner(owner, state) for owner, state in estop.states.items()),
            sending=sending,
            sending_text=text,
            stop=name,
        )

    def _note_progress(self, stop: _PressedStop, ref: str) -> None:
        """Mark a robot as changed if the present progress of its stop is not the one that pages were shown."""
        robots = stop.sender.robots
        if ref in robots and self._shown.get(ref) != _progress(robots[ref]):
            self.changed.add(ref)

    def _make_room(self, now: float) -> None:
        """Remove stops until there is room for another one."""
        while len(self._stops) >= MAX_STOPS:
            stop = min(self._stops.values(), key=_worth)
            if not stop.is_over:
                self._crowded_at = now
                log.warning("more than %d stops at once: that of %s is not confirmed", MAX_STOPS, stop.ref)
            self._remove(stop)

    def _remove(self, stop: _PressedStop) -> None:
        stop.sender.end()
        self.changed |= set(stop.sender.robots)
        del self._stops[stop.name], self._by_ref[stop.ref]

    def _newest(self, ref: str) -> tuple[str, RobotStop | None]:
        """Return the newest stop that is sent to this robot: its name, and the robot's part of it."""
        for name, stop in reversed(self._stops.items()):
            if ref in stop.sender.robots:
                return name, stop.sender.robots[ref]
        return "", None


def _worth(stop: _PressedStop) -> tuple[bool, bool, bool]:
    """Return a key that sorts stops for removal: over; of a robot never heard; of one robot; of all robots."""
    is_of_all = stop.ref == ""
    robots = stop.sender.robots.values()
    was_heard = is_of_all or any(robot.live or robot.estop.has_capabilities for robot in robots)
    return not stop.is_over, was_heard, is_of_all


def _progress(stop: RobotStop) -> tuple[str, str]:
    """Return the progress of a robot's stop, and what is missing in words: "" if it is confirmed and saved."""
    progress = stop.progress
    if progress is Progress.CONFIRMED and not stop.saved:
        return progress.value, "stopped, but not saved: after a power cut it is free"
    return progress.value, stop.why


def _owner(owner: str, state: EstopState) -> m.OwnerState:
    fields = {name: getattr(state, name) for name in m.OwnerState.__struct_fields__ if name != "owner"}
    return m.OwnerState(owner=owner, **fields)
