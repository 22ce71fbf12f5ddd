"""A program as operator: it drives one robot, stops it, and yields it to a person who wants it."""

from __future__ import annotations

import itertools
import math
import queue
import time
from collections.abc import Callable, Iterable, Iterator

from msgspec.structs import replace

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.extensions.operator.client.control import ControlClient
from pebble.extensions.operator.client.estop import StopSender, new_name
from pebble.extensions.operator.client.robot_estop import Reset
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS

RATE_HZ = 20.0  # at which a held stick is repeated
VALID_MS = 750  # of each command: no robot obeys one for longer


def paced(
    seconds: float = math.inf, rate_hz: float = RATE_HZ, wait: Callable[[float], object] = time.sleep
) -> Iterator[int]:
    """Yield 0, 1, 2 … at a steady rate, until ``wait`` returns true. A late step does not delay the following ones."""
    due = time.monotonic()
    for number in itertools.count() if math.isinf(seconds) else range(round(seconds * rate_hz)):
        yield number
        due += 1 / rate_hz
        if wait(max(0.0, due - time.monotonic())):
            return


class ScriptedOperator:
    """The operator of one robot; one thread calls it.

    Its owner passes the robot's messages to ``robot``. ``publish`` sends a message at once. If ``wait(seconds)``
    returns true or raises an exception, what is being done ends. ``device`` is shown to people who want control.
    """

    def __init__(
        self,
        robot: RobotView,
        publish: Callable[[Message], object],
        *,
        by: str,
        device: str = "program",
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self.robot = robot
        self.control = ControlClient(robot.control, by=by, device=device)
        self.newest: tuple[Drive, float] | None = None  # command that was sent, and when
        self._publish, self._by, self._wait = publish, by, wait
        self._stop: StopSender | None = None
        self._received: queue.SimpleQueue[Message] = queue.SimpleQueue()

    # -- driving

    def drive(self, x: float = 0.0, z: float = 0.0, seconds: float = math.inf) -> None:
        """Drive for ``seconds``, then release, also if the wait is interrupted."""
        try:
            for _ in paced(seconds, wait=self._wait):
                self.command(Drive(x=x, z=z))
        finally:
            self.command(Drive())

    def command(self, drive: Drive) -> float:
        """Send a drive command, with the control key if there is one; none while a person has control.

        A person who asks for control gets it. Return the time.monotonic() of sending; infinite if nothing was sent.
        """
        if self.control.asked_by:
            self.control.release()
        self.tick()
        if self._person_has_control():
            return math.inf
        drive = replace(drive, valid_ms=VALID_MS, key=self.control.key or drive.key)
        message = Message(self.robot.estop.drive_topic, codec.encode(DRIVE, drive), QoS(DRIVE.default_qos))
        now = time.monotonic()
        self.newest = drive, now
        self._publish(message)
        return now

    def ask_control(self) -> None:
        """Ask for control, if the robot has that; never take it from a person."""
        if self.robot.controlled and not self.control.wanted:
            self.control.ask(time.monotonic())

    @property
    def has_control(self) -> bool:
        """True if the operator has the control that it asked for; also if it did not ask, as a robot may give none."""
        return self.control.held or not self.control.wanted

    def release(self) -> None:
        """Release control."""
        self.control.release()
        self.tick()

    def _person_has_control(self) -> bool:
        state = self.robot.control.state if self.robot.controlled else None
        return state is not None and state.id not in ("", self.control.id)

    # -- the emergency stop

    def stop(self, why: str = "") -> None:
        """Begin an emergency stop, which ``tick`` repeats until it is confirmed."""
        self._stop = StopSender(new_name(), by=self._by, why=why, now=time.monotonic(), robots=[self.robot.base])
        self.tick()

    def receive(self, message: Message) -> None:
        """Keep any robot's message, retained or not, for ``tick``: some confirm a stop. Any thread may call this."""
        self._received.put(message)

    @property
    def stopped(self) -> bool:
        """True if the operator's newest stop is confirmed."""
        return self._stop is not None and self._stop.confirmed

    def reset(self) -> None:
        """End the operator's own emergency stop. A person's stop is left for a person to reset."""
        stop = self.robot.stopped_by
        if stop is None or stop.by == self._by:
            self._publish_all(Reset(self.robot.estop, self._by).messages())

    # -- what is due

    def tick(self) -> None:
        """Send the requests for control and the messages of a stop that are due; ``command`` calls this."""
        now = time.monotonic()
        self._publish_all(self.control.tick(now))
        while not self._received.empty():
            message = self._received.get()
            if self._stop is not None:
                self._stop.receive(message, now)
        if self._stop is not None:
            self._publish_all(self._stop.tick(now))

    def _publish_all(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self._publish(message)
