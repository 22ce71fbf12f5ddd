"""Visitors: people who take robots from the demo's operator, by driving or stopping them. Pure."""

import math
from collections import defaultdict, deque
from functools import partial

from pebble.contract.identity import parse_topic
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

DRIVES_S = 3.0  # so long after the last command of a person a robot is still the person's
_SENT = 1000  # drive commands of the operator that are on their way back: 50 s of a held stick, on a busy machine


class Visitors:
    """A table of the robots that people have. The demo's operator leaves them alone until it begins its next step.

    Times are seconds of one monotonic clock.
    """

    def __init__(self, name: str) -> None:
        """Make an empty table. ``name``: the demo's operator, whose own stops do not count as a person's."""
        self.left_alone: set[str] = set()  # names of robots that were found to be taken
        self.own_ids: set[str] = set()  # under which the operator itself has control
        self._name = name
        self._had: dict[str, tuple[float, str]] = {}  # by base topic: when a person last had it, and who
        self._moved: dict[str, float] = {}  # by base topic: when a person's last command came
        #: By topic: payloads of the operator's own commands that the broker has not sent back yet.
        self._sent: defaultdict[str, deque[bytes]] = defaultdict(partial(deque, maxlen=_SENT))
        self._step_began = 0.0

    def note_sent(self, topic: str, payload: bytes) -> None:
        """Note a drive command of the operator's own: when the broker sends it back, it is no person's."""
        self._sent[topic].append(payload)

    def receive_drive(self, message: Message, now: float) -> None:
        """Note that a person drives a robot, unless the operator itself has sent this command."""
        address, sent = parse_topic(message.topic), self._sent.get(message.topic)
        if sent and message.payload in sent:
            sent.remove(message.payload)
        elif address is not None and not message.retain:
            self._had[address.identity.base] = now, "another program"
            self._moved[address.identity.base] = now

    def begin_step(self, now: float) -> None:
        """Free all robots that people had in the last step."""
        self._step_began = now

    def taken(self, robot: RobotView, now: float) -> str:
        """Return why the robot counts as a person's now; empty if it is free."""
        state = robot.control.state if robot.controlled else None
        if state is not None and state.id and state.id not in self.own_ids:
            self._had[robot.base] = now, robot.control.who
        stop = robot.stopped_by
        if stop is not None and stop.by != self._name:
            return f"is stopped by {stop.by or 'unknown'}"
        at, who = self._had.get(robot.base, (-math.inf, ""))
        return f"is driven by {who}" if now - at < DRIVES_S else ""

    def rests(self, robot: RobotView, now: float) -> bool:
        """True if no person has moved the robot for a moment, even if one has control."""
        return now - self._moved.get(robot.base, -math.inf) >= DRIVES_S

    def free(self, robot: RobotView, now: float) -> bool:
        """True if no person has had the robot in the present step; else note it as left alone."""
        taken = self.taken(robot, now)  # first: it notes a person who has control
        had_at, _ = self._had.get(robot.base, (-math.inf, ""))
        if had_at < self._step_began and not taken:
            return True
        self.left_alone.add(robot.name)
        return False
