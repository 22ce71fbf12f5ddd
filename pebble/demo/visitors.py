"""Which robots people have taken from the demo's operator: driven by any program, or stopped. Pure."""

import math
from collections import defaultdict, deque
from contextlib import suppress
from functools import partial

from pebble.client.driver_lease import VALID_S
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVING, codec
from pebble.contract.identity import parse_topic
from pebble.errors import PayloadError
from pebble.transports import Message

_SENT = 1000  # drive commands of the operator that are on their way back: 50 s of a held stick, on a busy machine


class Visitors:
    """A robot that a person has had is free again in the step after. Times are seconds of one monotonic clock."""

    def __init__(self, name: str) -> None:
        """``name``: that of the operator, whose own stops are none of a person."""
        self.left_alone: set[str] = set()  # names of robots that were found to be taken
        self.own_ids: set[str] = set()  # under which the operator itself has control
        self._name = name
        self._driven: dict[str, float] = {}  # by base topic: when another one drove it, or was announced to
        self._moved: dict[str, float] = {}  # by base topic: when a person's command came
        self._drivers: dict[str, tuple[str, float]] = {}  # those that were announced
        self._sent: defaultdict[str, deque[bytes]] = defaultdict(partial(deque, maxlen=_SENT))  # by topic
        self._step_began = 0.0

    def receive(self, message: Message, now: float) -> None:
        """A server announces once a second which robots are driven; what the broker retained is older."""
        if message.retain:
            return
        with suppress(PayloadError):
            for base, driver in codec.decode(DRIVING, message.payload).robots.items():
                who = f"{driver.by} on {driver.device}" if driver.device else driver.by
                self._drivers[base], self._driven[base] = (who, now), now

    def note_sent(self, topic: str, payload: bytes) -> None:
        """The operator drives a robot by this, which the broker sends back to it."""
        self._sent[topic].append(payload)

    def receive_drive(self, message: Message, now: float) -> None:
        """Take any drive command of any robot: the operator's own, or one that was pasted into a terminal."""
        address, sent = parse_topic(message.topic), self._sent.get(message.topic)
        if sent and message.payload in sent:
            sent.remove(message.payload)
        elif address is not None and not message.retain:
            self._driven[address.identity.base] = self._moved[address.identity.base] = now

    def begin_step(self, now: float) -> None:
        """What people had before no longer counts."""
        self._step_began = now

    def taken(self, robot: RobotView, now: float) -> str:
        """Why people have the control of it now; empty: they have not."""
        state = robot.control.state if robot.controlled else None
        if state is not None and state.id and state.id not in self.own_ids:  # as it tells itself
            self._drivers[robot.base], self._driven[robot.base] = (robot.control.who, now), now
        stop = robot.stopped_by
        if stop is not None and stop.by != self._name:
            return f"is stopped by {stop.by or 'unknown'}"
        if now - self._driven.get(robot.base, -math.inf) >= VALID_S:
            return ""
        who, at = self._drivers.get(robot.base, ("", -math.inf))
        return f"is driven by {who if now - at < VALID_S else 'another program'}"

    def rests(self, robot: RobotView, now: float) -> bool:
        """Whether no person has moved it for a moment, also if one has the control."""
        return now - self._moved.get(robot.base, -math.inf) >= VALID_S

    def free(self, robot: RobotView, now: float) -> bool:
        """Whether it may be driven in the present step, in which no person has had it so far."""
        if self._driven.get(robot.base, -math.inf) < self._step_began and not self.taken(robot, now):
            return True
        self.left_alone.add(robot.name)
        return False
