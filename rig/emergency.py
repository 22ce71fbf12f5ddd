"""The scripted operator's emergency stop: all robots are stopped, driven in vain, and reset."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pebble.client.discovery import DiscoveredRobot
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset, RobotEstop
from pebble.contract.payloads import Drive
from pebble.rig.steps import COMMAND_PERIOD_S, repeat
from pebble.transports import Message, Transport

NAME = "emergency stop"
_BEFORE_S, _IN_VAIN_S, _RESET_S, _AFTER_S, _REST_S = 0.8, 1.0, 0.8, 0.6, 0.8
DURATION_S = _BEFORE_S + _IN_VAIN_S + _RESET_S + _AFTER_S + _REST_S + 0.5
_CONFIRMED_S = 3.0  # until every robot has confirmed, on the smallest machine
_FORWARD = Drive(z=0.5)


@dataclass(frozen=True, slots=True)
class CompletedStop:
    """An emergency stop of one robot. Times are time.monotonic() of the operator."""

    robot: str  # its id
    pressed: float
    confirmed_s: float | None  # after the press
    reset: float  # when the reset was sent
    is_free: bool  # after the reset
    ended: float

    @property
    def began(self) -> float:
        """The driving before it."""
        return self.pressed - _BEFORE_S


class EmergencyStop:
    """One stop of all robots, on the operator's thread. ``receive`` runs on the transport's.

    ``drive(axes)`` sends a drive command to all robots; ``wait(seconds)`` returns True if the demo ends.
    """

    def __init__(
        self, transport: Transport, drive: Callable[[Drive], None], wait: Callable[[float], bool], by: str
    ) -> None:
        self._transport, self._drive, self._wait, self._by = transport, drive, wait, by
        self._received: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._robots: dict[str, RobotEstop] = {}

    def receive(self, message: Message) -> None:
        self._received.put(message)

    def perform(self, robots: Sequence[DiscoveredRobot]) -> list[CompletedStop]:
        """Drive, stop, drive in vain, reset, drive again; an empty list if the demo ends meanwhile."""
        self._robots = {robot.base: RobotEstop(robot.base) for robot in robots}
        if self._keep_driving(_BEFORE_S):
            return []
        pressed = time.monotonic()
        sender = StopSender(new_name(), by=self._by, why="part of the demo", now=pressed, robots=list(self._robots))
        while not sender.confirmed and time.monotonic() < pressed + _CONFIRMED_S:
            self._publish(sender.tick(time.monotonic()))
            self._drive(_FORWARD)
            if self._wait(COMMAND_PERIOD_S):
                return []
            self._take(sender)
        sender.end()
        if self._keep_driving(_IN_VAIN_S):
            return []
        self._take(sender)
        mine = {base: robot for base, robot in self._robots.items() if not self._stopped_by_another(robot)}
        resets = {base: Reset(robot, self._by) for base, robot in mine.items()}
        reset_at = time.monotonic()
        for reset in resets.values():
            self._publish(reset.messages())
        if self._wait(_RESET_S) or self._keep_driving(_AFTER_S):
            return []
        self._drive(Drive())
        ended = time.monotonic()
        if self._wait(_REST_S):
            return []
        self._take(sender)
        return [
            CompletedStop(
                robot.name,
                pressed,
                sender.robots[robot.base].confirmed_s,
                reset_at,
                bool(resets[robot.base].shown) and resets[robot.base].free,
                ended,
            )
            for robot in robots
            if robot.base in resets
        ]

    def _stopped_by_another(self, robot: RobotEstop) -> bool:
        """A person's stop is the person's to reset."""
        stop = robot.stopped_by
        return stop is not None and stop.by != self._by

    def _keep_driving(self, seconds: float) -> bool:
        """True if the demo ends."""
        return repeat(lambda: self._drive(_FORWARD), self._wait, seconds)

    def _take(self, sender: StopSender) -> None:
        """Pass on what was received."""
        while not self._received.empty():
            message = self._received.get()
            sender.receive(message, time.monotonic())
            for robot in self._robots.values():
                robot.receive(message)

    def _publish(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)
