"""Asks for retained messages of robots by name: some brokers send them to no subscription with wildcards."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from math import inf
from typing import Final

from pebble.contract import CAPABILITIES, CHANNELS, LINK, ONLINE, Channel
from pebble.contract.identity import Direction, parse_topic
from pebble.contract.levels import level_of, silent_after
from pebble.contract.payloads import LinkLevel
from pebble.runtime.robot_estop import RobotEstop
from pebble.transports import Message, State, Transport

log = logging.getLogger(__name__)

EACH_S: Final = 0.05  # between two robots that are asked for
MAX_ROBOTS: Final = 2000  # those known from before need no room
_PAUSES_S = (1.0, 5.0, 30.0)  # before each time that one is asked for; it may have none
_LASTS_S = 0.5
_SWEEP_S = 1.0  # between two searches for such places

_HEARTBEATS = frozenset(one.metric for one in CHANNELS if ONLINE.metric in (one.metric, one.synonym_of))


class _Robot:
    """A robot as the present connection shows it. Times are None or infinite until there is one."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.estop: RobotEstop | None = None  # since it was asked for
        self.due = inf  # when it is asked for next
        self.asked = 0
        self.link: LinkLevel = "wide"
        self._began: float | None = None  # its first heartbeat
        self._newest_at = -inf  # its newest one
        self._pauses: Iterator[float] = iter(_PAUSES_S)

    @property
    def lasts(self) -> bool:
        """Whether it goes on sending heartbeats: it takes more to invent many such robots."""
        return self._began is not None and self._newest_at - self._began >= _LASTS_S

    def is_silent(self, now: float) -> bool:
        return now - self._newest_at > silent_after(link=self.link)

    def may_go(self, now: float) -> bool:
        """Whether its place may be another one's."""
        return self.due == inf or self.is_silent(now)

    def heartbeat(self, now: float) -> None:
        self._newest_at = now
        if self._began is None:
            self._began = now
            self.due = now + next(self._pauses, inf)

    def receive(self, message: Message, now: float) -> None:
        """Capabilities, or the state of a motor owner."""
        if self.estop is None:
            if message.topic == CAPABILITIES.topic(self.base):  # they come by themselves, and so does the rest
                self._pauses, self.due = iter(()), inf
            return
        had = self.estop.has_capabilities
        self.estop.receive(message)
        if self.estop.has_capabilities and not had:
            self._pauses, self.due = iter(_PAUSES_S[1:]), now  # for the states of the owners that they list

    def ask(self, now: float, channels: Collection[Channel]) -> list[str]:
        """The topics to ask for; empty: nothing is missing."""
        estop = self.estop = self.estop or RobotEstop(self.base)
        known = [*estop.missing, *estop.missing_control]
        topics = known if estop.has_capabilities else [channel.topic(estop.base) for channel in channels]
        self.asked += bool(topics)
        self.due = now + next(self._pauses, inf) if topics else inf
        return topics


class ByName:
    """Decides which robots are asked for, and for what: those whose capabilities do not come by themselves.

    A robot is asked for 1 s after its first heartbeat on the present connection, then twice more; when it answers, for
    the states of the motor owners that its capabilities list, and for who has control of them. Anybody can invent
    robots: one is asked for at a time, first those known from before, those that have answered, and those that go on
    sending heartbeats.
    One thread may receive, and another ask.
    """

    def __init__(self, channels: Iterable[Channel] = (), is_known: Callable[[str], bool] = lambda _: False) -> None:
        """``channels``: what is asked for beside capabilities and emergency stops, of those that are retained."""
        named = [one for one in channels if one.default_retain and not one.is_pattern]
        self._channels = tuple(dict.fromkeys((CAPABILITIES, *(one for one in named if one.metric not in _HEARTBEATS))))
        self._is_known = is_known
        self._robots: dict[str, _Robot] = {}
        self._next = self._swept_at = -inf
        self.omitted = 0  # messages of robots for which there was no place

    @property
    def waits(self) -> bool:
        """Whether a robot has not been asked for yet that will be."""
        return any(robot.due < inf and not robot.asked for robot in list(self._robots.values()))

    def reset(self) -> None:
        """The connection is lost: what comes by the next one is not known."""
        self._robots = {}

    def forget(self, base: str) -> None:
        """What has come of this robot is not known any more: its next heartbeat is its first one."""
        self._robots.pop(base, None)

    def receive(self, message: Message, now: float) -> None:
        """Take any message of any robot."""
        address = parse_topic(message.topic)
        if address is None or address.direction is not Direction.OUTGOING:
            return
        metric = address.metric
        if metric == LINK.metric and (known := self._robots.get(address.identity.base)) is not None:
            known.link = level_of(message.payload)
        if not message.payload:
            return
        is_heartbeat = metric in _HEARTBEATS
        if is_heartbeat and message.retain:
            return  # no sign of life
        if is_heartbeat or metric == CAPABILITIES.metric or metric.startswith("estop/"):
            robot = None if address.identity.is_server else self._robot(address.identity.base, now)
            if robot is not None and is_heartbeat:
                robot.heartbeat(now)
            elif robot is not None:
                robot.receive(message, now)

    def take(self, now: float) -> list[str]:
        """The topics of one robot to ask for now; empty: none."""
        due = [] if now < self._next else [one for one in list(self._robots.values()) if one.due <= now]
        due.sort(key=lambda robot: self._rank(robot, now))
        for robot in due:
            if topics := robot.ask(now, self._channels):
                self._next = now + EACH_S
                return topics
        return []

    def _rank(self, robot: _Robot, now: float) -> tuple[bool, bool, bool, bool, int, float]:
        is_known, is_silent = self._is_known(robot.base), robot.is_silent(now)
        has_answered = robot.estop is not None and robot.estop.has_capabilities
        return not is_known, is_silent, not has_answered, not robot.lasts, robot.asked, robot.due

    def _robot(self, base: str, now: float) -> _Robot | None:
        robot = self._robots.get(base)
        if robot is not None:
            return robot
        if len(self._robots) >= MAX_ROBOTS and now - self._swept_at >= _SWEEP_S:
            self._swept_at = now
            rest = {name: one for name, one in self._robots.items() if self._is_known(name) or not one.may_go(now)}
            self._robots = rest
        if len(self._robots) >= MAX_ROBOTS and not self._is_known(base):
            self.omitted += 1
            if self.omitted & (self.omitted - 1) == 0:  # the 1st, 2nd, 4th, 8th …
                log.warning("%d messages of robots too many, the last of %s: not asked for", self.omitted, base)
            return None
        robot = self._robots[base] = _Robot(base)
        return robot


def ask_beside(transport: Transport, by_name: ByName) -> None:
    """Ask for what is missing on a thread of its own, because it waits for answers, until the transport is closed."""

    def run() -> None:
        while transport.state is not State.CLOSED:
            if transport.state is State.CONNECTED and (topics := by_name.take(time.monotonic())):
                transport.ask(topics)
            time.sleep(EACH_S)

    transport.on_state(lambda state: None if state is State.CONNECTED else by_name.reset())
    threading.Thread(target=run, name="pebble-by-name", daemon=True).start()
