"""A scripted operator: discovers robots on a broker, drives them through the same steps, and overrules a script.

It yields to people: a robot that is driven or was stopped from the operator page is left alone until the step after.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from pebble.client.discovery import ALL_OUTGOING, DiscoveredRobot, Discovery
from pebble.contract import DRIVE, DRIVING, LIGHTS_FLASH, LIGHTS_SOLID, codec
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import Drive, Driver, LightsFlash
from pebble.errors import PayloadError, PebbleError
from pebble.rig.acts import (
    BY_ITSELF,
    COMMAND_PERIOD_S,
    EMERGENCY_STOP,
    SCRIPT,
    CompletedFollow,
    CompletedStep,
    CompletedStop,
    EndedEarlyError,
    Step,
    TakeOver,
    emergency_stop,
    repeat,
)
from pebble.transports import Message, MqttSettings, QoS, create

STOP = Drive()
NAME = "the demo's operator"
_POLL_S = 0.02
_COMPLETED = 1000  # finished steps that wait to be assessed
_EVENTS = 100  # that wait to be shown
_MOST_TIMES = 3  # for the emergency stop and for the script
_ASSESSED_S = 5.0  # until what was completed is assessed, on the smallest machine
_BACK_OFF, _BACK_OFF_S = Drive(z=-0.5), 1.0
EXPIRES_S = 3.0  # of a visit; announcements come every second


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
        with suppress(EndedEarlyError):
            while not (self._yours and self.rounds):
                for step in SCRIPT:
                    self._perform(step, self._begin(step.name, robots))
                if not self.rounds:
                    self._until_right(EMERGENCY_STOP, lambda: self._stop_all(robots))
                    self._until_right(BY_ITSELF, lambda: self._take_over(robots))
                self.rounds += 1
            self._doing = self._yours
            self._stopping.wait()
        self._send(STOP, self._begin("disconnecting", robots))

    def _wait(self, seconds: float) -> None:
        if self._stopping.wait(seconds):
            raise EndedEarlyError

    def _until_right(self, name: str, act: Callable[[], None]) -> None:
        """Once, and again while its assessment leaves ``name`` in ``again``."""
        for _ in range(_MOST_TIMES):
            act()
            end = time.monotonic() + _ASSESSED_S
            while self.completed and time.monotonic() < end:
                self._wait(COMMAND_PERIOD_S)
            if name not in self.again:
                return

    def _begin(self, step: str, robots: list[DiscoveredRobot]) -> list[DiscoveredRobot]:
        """The robots that take part in the next step."""
        self._doing, self._step_began = step, time.monotonic()
        return [robot for robot in robots if self._mine(robot)]

    def _perform(self, step: Step, robots: list[DiscoveredRobot]) -> None:
        began = time.monotonic()
        flash = isinstance(step.lights, LightsFlash)
        lights = codec.encode(LIGHTS_FLASH if flash else LIGHTS_SOLID, step.lights)
        for robot in robots:
            self._publish(robot.lights_topic(flash=flash), lights)
        released = repeat(lambda: self._send(step.drive, robots), self._wait, step.drive_s)
        if step.sends_stop:
            self._send(STOP, robots)
            released = time.monotonic()
        self._doing = f"{step.name}: observing"
        self._wait(step.rest_s)
        ended = time.monotonic()
        self.completed.extend(
            CompletedStep(robot.name, step, began, released, ended) for robot in robots if self._mine(robot)
        )

    def _stop_all(self, robots: list[DiscoveredRobot]) -> None:
        robots = self._begin(EMERGENCY_STOP, robots)
        completed = emergency_stop(self._transport, robots, partial(self._send, robots=robots), self._wait, NAME)
        mine = {robot.name for robot in robots if self._mine(robot)}
        self.completed.extend(one for one in completed if one.robot in mine)

    def _take_over(self, robots: list[DiscoveredRobot]) -> None:
        """Let each robot with scripts follow a tag, and overrule the script for a moment."""
        for robot in self._begin("scripts", [robot for robot in robots if robot.offers("autonomy")]):
            drive, wait = partial(self._send, robots=[robot]), partial(self._wait_with, robot)
            with suppress(EndedEarlyError):
                if BY_ITSELF in self.again:  # away from the tag before which it arrived, for a way to drive
                    repeat(partial(drive, _BACK_OFF), wait, _BACK_OFF_S)
                    drive(STOP)
                self.completed.append(TakeOver(self._transport, robot, drive, wait, self._note).perform())
            self._wait(0.0)

    def _wait_with(self, robot: DiscoveredRobot, seconds: float) -> None:
        self._wait(seconds)
        if not self._mine(robot):
            raise EndedEarlyError

    def _note(self, what: str, text: str) -> None:
        self._doing = f"{what}: {text}"
        self.show(f"{what}: {text}")

    def _send(self, drive: Drive, robots: list[DiscoveredRobot]) -> None:
        payload = codec.encode(DRIVE, drive)
        for robot in filter(self._mine, robots):
            self.commands[robot.base] = drive, time.monotonic()
            self._publish(robot.drive_topic, payload)

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)


# -- people at the page


class _Visit(NamedTuple):
    server: str
    driver: Driver | None  # None: it is over
    announced: float  # monotonic


class Visitors:
    """Which robots people drive from the operator page, by what its server announces; times are monotonic. Pure.

    It has the newest visit of every robot, by base topic. One thread receives, another reads.
    """

    def __init__(self) -> None:
        self._visits: dict[str, _Visit] = {}

    def receive(self, message: Message, now: float) -> None:
        address = parse_topic(message.topic)
        if address is None or not address.identity.is_server or message.retain:
            return
        try:
            driven = codec.decode(DRIVING, message.payload).robots
        except PayloadError:  # from something that is no server of ours
            return
        server = address.identity.id
        running = [base for base, visit in self._visits.items() if visit.server == server and visit.driver is not None]
        self._visits |= {base: _Visit(server, driven.get(base), now) for base in {*running, *driven}}

    def driver(self, base: str, now: float) -> str:
        """Who has that robot now, for display; empty: nobody."""
        visit = self._visits.get(base)
        if visit is None or visit.driver is None or now - visit.announced > EXPIRES_S:
            return ""
        return f"{visit.driver.by} on {visit.driver.device}" if visit.driver.device else visit.driver.by

    def driven_since(self, base: str, since: float, now: float) -> bool:
        """Whether a person has it, or had it at any time after ``since``."""
        visit = self._visits.get(base)
        return visit is not None and (visit.announced >= since or bool(self.driver(base, now)))
