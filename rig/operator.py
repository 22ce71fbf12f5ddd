"""A scripted operator: discovers robots on a broker, drives them through the same steps, and overrules a script.

It yields to people: a robot that is driven or was stopped from the operator page is left alone until the step after.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from pebble.client.discovery import ALL_OUTGOING, DiscoveredRobot, Discovery
from pebble.contract import DRIVE, LIGHTS_FLASH, LIGHTS_SOLID, codec
from pebble.contract.payloads import Drive, LightsFlash
from pebble.errors import PebbleError
from pebble.rig.emergency import NAME as EMERGENCY_STOP
from pebble.rig.emergency import CompletedStop, EmergencyStop
from pebble.rig.steps import COMMAND_PERIOD_S, SCRIPT, CompletedStep, Step, repeat
from pebble.rig.takeover import NAME as BY_ITSELF
from pebble.rig.takeover import CompletedFollow, TakeOver
from pebble.rig.visitors import Visitors
from pebble.transports import Message, MqttSettings, QoS, create

STOP = Drive()
NAME = "the demo's operator"
_POLL_S = 0.02
_COMPLETED = 1000  # finished steps that wait to be assessed
_EVENTS = 100  # that wait to be shown
_MOST_TIMES = 3  # for the emergency stop and for the script
_ASSESSED_S = 5.0  # until what was completed is assessed, on the smallest machine
_BACK_OFF, _BACK_OFF_S = Drive(z=-0.5), 1.0


class Operator:
    """Drives on its own thread and connection.

    ``activity`` and ``events`` (monotonic seconds and a line) are for display; ``completed`` collects finished steps,
    and ``left_alone`` the names of robots of which people had the control meanwhile. The emergency stop and the script
    belong to the first round; while ``again`` has their names, they are repeated at once. Whoever assesses what was
    completed removes it only then.
    """

    def __init__(self, port: int, name: str = "pebble-demo-operator") -> None:
        self.discovery, self.visitors = Discovery(), Visitors()
        self.left_alone: set[str] = set()
        self.again: frozenset[str] = frozenset()
        self.rounds = 0
        self.commands: dict[str, tuple[Drive, float]] = {}  # by base topic: the last one sent, and when (monotonic)
        self.events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self.completed: deque[CompletedStep | CompletedStop | CompletedFollow] = deque(maxlen=_COMPLETED)
        self._doing = "discovering robots"
        self._step_began = 0.0
        self._yours = ""
        self._transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._drive, name=name, daemon=True)

    def connect(self) -> None:
        """Connect and subscribe; returns at once."""
        self._transport.open(timeout=0.0)
        self._transport.subscribe(ALL_OUTGOING, self._receive)

    def ready(self, wanted: int) -> bool:
        """Are that many robots online, with a drive topic?"""
        now = time.monotonic()
        return sum(robot.ready(now) for robot in self.discovery.all_robots()) >= wanted

    def wait_until_ready(self, wanted: int, timeout: float, problems: Callable[[], list[str]]) -> None:
        """Wait until so many robots can be driven. Raises PebbleError after a timeout, or if there are problems."""
        end = time.monotonic() + timeout
        while not self.ready(wanted):
            if (found := problems()) or time.monotonic() > end:
                raise PebbleError("; ".join(found) or "the robots did not become ready to drive")
            time.sleep(_POLL_S)

    def show(self, event: str) -> None:
        """Add a line to the events."""
        self.events.append((time.monotonic(), f"operator {event}"))

    @property
    def activity(self) -> str:
        """What it does, and which robots it leaves alone."""
        now = time.monotonic()
        others = [f"{robot.name} {why}" for robot in self.discovery.all_robots() if (why := self._taken(robot, now))]
        return "; ".join([self._doing, *others])

    def begin(self, yours: str = "") -> None:
        """Start driving all robots discovered so far, round after round; with ``yours`` only once, and then show it."""
        self._yours = yours
        self._thread.start()

    def close(self) -> None:
        """Interrupt the step, stop all robots and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._transport.close()

    def _receive(self, message: Message) -> None:
        self.discovery.receive(message, time.monotonic(), time.time())
        self.visitors.receive(message, time.monotonic())

    # -- people at the page

    def _taken(self, robot: DiscoveredRobot, now: float) -> str:
        """Why people have the control of it now; empty: they have not."""
        if driver := self.visitors.driver(robot.base, now):
            return f"is driven by {driver}"
        stop = robot.stopped_by
        return "" if stop is None or stop.by == NAME else f"is stopped by {stop.by or 'unknown'}"

    def _mine(self, robot: DiscoveredRobot) -> bool:
        """Whether it may be driven in the present step."""
        now = time.monotonic()
        if not self._taken(robot, now) and not self.visitors.driven_since(robot.base, self._step_began, now):
            return True
        self.left_alone.add(robot.name)
        return False

    # -- the operator's thread

    def _drive(self) -> None:
        robots = self.discovery.all_robots()
        while not self._stopping.is_set() and not (self._yours and self.rounds):
            for step in SCRIPT:
                self._perform(step, self._begin(step.name, robots))
                if self._stopping.is_set():
                    break
            else:
                if not self.rounds:
                    self._until_right(EMERGENCY_STOP, lambda: self._stop_all(robots))
                    self._until_right(BY_ITSELF, lambda: self._take_over(robots))
                self.rounds += 1
        if not self._stopping.is_set():
            self._doing = self._yours
            self._stopping.wait()
        self._send(STOP, self._begin("disconnecting", robots))

    def _until_right(self, name: str, act: Callable[[], None]) -> None:
        """Once, and again while its assessment leaves ``name`` in ``again``."""
        for _ in range(_MOST_TIMES):
            act()
            end = time.monotonic() + _ASSESSED_S
            while self.completed and time.monotonic() < end:
                if self._stopping.wait(COMMAND_PERIOD_S):
                    return
            if name not in self.again:
                return

    def _begin(self, step: str, robots: list[DiscoveredRobot]) -> list[DiscoveredRobot]:
        """The robots that take part in the next step."""
        self._doing, self._step_began = step, time.monotonic()
        return [robot for robot in robots if self._mine(robot)]

    def _perform(self, step: Step, robots: list[DiscoveredRobot]) -> None:
        began = due = released = time.monotonic()
        self._switch_lights(step, robots)
        while due < began + step.drive_s:
            self._send(step.drive, robots)
            released = time.monotonic()
            due += COMMAND_PERIOD_S
            if self._stopping.wait(max(0.0, due - released)):
                return
        if step.sends_stop:
            self._send(STOP, robots)
            released = time.monotonic()
        self._doing = f"{step.name}: observing"
        if self._stopping.wait(step.rest_s):
            return
        ended = time.monotonic()
        self.completed.extend(
            CompletedStep(robot.name, step, began, released, ended) for robot in robots if self._mine(robot)
        )

    def _stop_all(self, robots: list[DiscoveredRobot]) -> None:
        """Stop all robots, try to drive them, and reset them."""
        robots = self._begin(EMERGENCY_STOP, robots)
        emergency = EmergencyStop(
            self._transport, lambda drive: self._send(drive, robots), self._stopping.wait, by=NAME
        )
        subscription = self._transport.subscribe(ALL_OUTGOING, emergency.receive)  # brings retained capabilities again
        completed = emergency.perform(robots)
        subscription.close()
        mine = {robot.name for robot in robots if self._mine(robot)}
        self.completed.extend(one for one in completed if one.robot in mine)

    def _take_over(self, robots: list[DiscoveredRobot]) -> None:
        """Let each robot with scripts follow a tag, and overrule the script for a moment."""
        for robot in self._begin("scripts", [robot for robot in robots if robot.offers("autonomy")]):
            if BY_ITSELF in self.again:
                self._back_off(robot)
            if not self._stopping.is_set():
                drive = partial(self._send, robots=[robot])
                wait = partial(self._wait_with, robot)
                completed = TakeOver(self._transport, robot, drive, wait, self._note).perform()
                self.completed.extend([completed] if completed else [])

    def _back_off(self, robot: DiscoveredRobot) -> None:
        """Away from the tag before which it arrived, so that there is a way to drive."""
        repeat(lambda: self._send(_BACK_OFF, [robot]), partial(self._wait_with, robot), _BACK_OFF_S)
        self._send(STOP, [robot])

    def _wait_with(self, robot: DiscoveredRobot, seconds: float) -> bool:
        """True if the demo ends, or a person has taken this robot."""
        return self._stopping.wait(seconds) or not self._mine(robot)

    def _note(self, what: str, text: str) -> None:
        self._doing = f"{what}: {text}"
        self.show(f"{what}: {text}")

    def _send(self, drive: Drive, robots: list[DiscoveredRobot]) -> None:
        payload = codec.encode(DRIVE, drive)
        for robot in filter(self._mine, robots):
            self.commands[robot.base] = drive, time.monotonic()
            self._publish(robot.drive_topic, payload)

    def _switch_lights(self, step: Step, robots: list[DiscoveredRobot]) -> None:
        flash = isinstance(step.lights, LightsFlash)
        payload = codec.encode(LIGHTS_FLASH if flash else LIGHTS_SOLID, step.lights)
        for robot in robots:
            self._publish(robot.lights_topic(flash=flash), payload)

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)
