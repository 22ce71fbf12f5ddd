"""A scripted operator drives the robots of a broker: steps, an emergency stop, and a script that it overrules.

It yields to people: a robot that another person drives, or has stopped, is left alone until the step after.
Times are seconds of time.monotonic().
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from typing import NamedTuple

from pebble import contract
from pebble.client.discovery import ALL_OUTGOING, Discovery
from pebble.client.driver_lease import FILTER
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset
from pebble.client.robot_view import RobotView
from pebble.contract import (
    APRILTAG_DATA,
    AUTONOMY_COMMAND,
    AUTONOMY_FILES,
    DRIVE,
    SOUNDBOARD_COMMAND,
    WHEEL_ODOMETRY,
    codec,
)
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import AutonomyCommand, Drive, LightsFlash, LightsSolid, SoundboardCommand, TagData
from pebble.demo.steering import Steering
from pebble.demo.visitors import Visitors
from pebble.errors import PayloadError
from pebble.motion.arbiter import HOLD_MS
from pebble.rig.testbed import CLIP, TAG_ID
from pebble.transports import Message, MqttSettings, QoS, create

COMMAND_PERIOD_S = 0.05  # how often a held stick is repeated
NAME = "demo-operator"
STOP = Drive()
OBSERVING = ": observing"  # after the name of a step
_POLL_S = 0.02
_MOST_TIMES = 3  # for the emergency stop and for the script
_MOST_WAITING = 1000  # events and completed steps; beyond them the oldest is dropped
_ASSESSED_S = 5.0  # until what was completed is assessed, on the smallest machine

Wheels = tuple[float, float]  # left and right, -1..1


def wheels_of(drive: Drive) -> Wheels:
    """How fast a command turns the wheels; none of the demo's asks for more than full speed."""
    return drive.z + drive.x, drive.z - drive.x


class Step(NamedTuple):
    """Repeat ``drive`` for ``drive_s``, then send a stop or simply nothing more, and observe for ``rest_s``."""

    name: str
    drive: Drive
    drive_s: float
    sends_stop: bool
    rest_s: float
    lights: LightsSolid | LightsFlash


SCRIPT = (
    Step("forward, stop", Drive(z=0.6), 1.2, True, 1.4, LightsSolid(g=1.0)),
    Step("turn right, stop", Drive(x=0.35), 0.8, True, 1.4, LightsFlash(b=1.0, period=0.5)),
    Step("forward, let go", Drive(z=0.6), 0.8, False, 1.4, LightsSolid(r=1.0)),
    Step("back, stop", Drive(z=-0.5), 0.8, True, 1.4, LightsSolid(b=0.3, g=0.3, r=0.3)),
)
ROUND_S = sum(step.drive_s + step.rest_s for step in SCRIPT)

EMERGENCY_STOP = "emergency stop"  # of all robots, which are driven in vain, and reset
_BEFORE_S, _IN_VAIN_S, _RESET_S, _AFTER_S, _STOPPED_REST_S = 0.8, 1.0, 0.8, 0.6, 0.8
EMERGENCY_S = _BEFORE_S + _IN_VAIN_S + _RESET_S + _AFTER_S + _STOPPED_REST_S + 0.5
_CONFIRMED_S = 3.0  # until every robot has confirmed, on the smallest machine
_FORWARD = Drive(z=0.5)

BY_ITSELF = "by itself"  # a robot follows a tag by a script, and is driven for a moment in between
FOLLOW = "apriltag-follow"
TRAIL = WHEEL_ODOMETRY.metric  # the script of this name; it draws the map of the operator page
TAG_SIZE_M = 0.25
DISTANCE_M, TOLERANCE_M = 0.9, 0.05
HOLD_S = HOLD_MS / 1000  # scripts are refused this long after a person's last command
_APPROACH_S, _OVERRIDE_S, _STEADY_S, _FOLLOWED_REST_S = 1.0, 1.0, 0.8, 0.5
_START_S, _ARRIVAL_S = 10.0, 10.0  # at most, on the smallest machine
_STATUS_S = 1.0  # until the robot's status has changed
_LISTED_S = 20.0  # until a robot has listed its scripts, on the smallest machine
_TRAIL_S = 3.0  # until a script that was started runs
#: Of most runs; a slow one takes longer.
TAKEOVER_S = 2.0 + _APPROACH_S + _OVERRIDE_S + HOLD_S + 4.5 + _STEADY_S + _FOLLOWED_REST_S
_BACK = Drive(x=-0.1, z=-0.5)
_BACK_OFF, _BACK_OFF_S = Drive(z=-0.5), 1.0


class CompletedStep(NamedTuple):
    """A step that was sent to one robot."""

    robot: str  # its id
    step: Step
    began: float
    released: float  # the last moving command, or the stop command if the step sends one
    ended: float


class CompletedStop(NamedTuple):
    """An emergency stop of one robot."""

    robot: str
    began: float  # the driving before it
    pressed: float
    confirmed_s: float | None  # after the press
    reset: float  # when the reset was sent
    is_free: bool  # after the reset
    ended: float


class CompletedFollow(NamedTuple):
    """A script on one robot, and what the operator did."""

    robot: str
    began: float  # the script
    took_over: float  # first drive command
    wheels: Wheels  # of the operator's drive commands
    released: float  # the zero after them
    ended: float  # the script, by a stop command
    clip: str


class EndedEarlyError(Exception):
    """The demo ends, or a person has taken the robot."""


class Operator:
    """Drives on its own thread and connection.

    ``activity`` and ``events`` (seconds and a line) are for display; ``completed`` collects finished steps, and
    ``left_alone`` the names of robots of which people had the control meanwhile. The emergency stop and the script
    belong to the first round; while ``again`` has their names, they are repeated at once. Those who assess what was
    completed removes it only then.
    """

    def __init__(self, port: int, name: str = "pebble-demo-operator") -> None:
        self.discovery = Discovery()
        self.again: frozenset[str] = frozenset()
        self.rounds = 0
        self.events: deque[tuple[float, str]] = deque(maxlen=_MOST_WAITING)
        self.completed: deque[CompletedStep | CompletedStop | CompletedFollow] = deque(maxlen=_MOST_WAITING)
        self._doing = "discovering robots"
        self._visitors = Visitors(NAME)
        self.steering = Steering(NAME, self._publish_all, self._visitors.own_ids)
        self._drawing: set[str] = set()  # base topics of robots that have listed the script for their trail
        self._robots: list[RobotView] = []  # that take part in the present step
        self._scripted: RobotView | None = None  # if a person takes it, the present step ends
        self._transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread()

    def connect(self) -> None:
        """Connect and subscribe; returns at once."""
        self._transport.open(timeout=0.0)
        self._transport.subscribe(ALL_OUTGOING, lambda one: self.discovery.receive(one, time.monotonic(), time.time()))
        self._transport.subscribe(FILTER, lambda one: self._visitors.receive(one, time.monotonic()))
        drives = DRIVE.filter("+/+/+")
        self._transport.subscribe(drives, lambda one: self._visitors.receive_drive(one, time.monotonic()))
        self._transport.subscribe(AUTONOMY_FILES.filter("+/+/+"), self._receive_scripts)

    def ready(self, wanted: int) -> bool:
        """Are that many robots online, with a drive topic?"""
        now = time.monotonic()
        return sum(robot.ready(now) for robot in self.discovery.all_robots()) >= wanted

    def show(self, event: str) -> None:
        self._doing = event
        self.events.append((time.monotonic(), f"operator {event}"))

    @property
    def activity(self) -> str:
        """What it does, and which robots it leaves alone."""
        robots, now = self.discovery.all_robots(), time.monotonic()
        others = [f"{robot.name} {why}" for robot in robots if (why := self._visitors.taken(robot, now))]
        return "; ".join([self._doing, *others])

    @property
    def left_alone(self) -> set[str]:
        """Names of robots of which people had the control meanwhile."""
        return self._visitors.left_alone

    def begin(self, yours: str = "") -> None:
        """Start driving all robots discovered so far, round after round; with ``yours`` only once, and then show it."""
        self._thread = threading.Thread(target=self._run, args=(yours,), name="operator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Interrupt the step, stop all robots and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._transport.close()

    def _receive_scripts(self, message: Message) -> None:
        address = parse_topic(message.topic)
        with suppress(PayloadError):
            files = codec.decode(AUTONOMY_FILES, message.payload).files if message.payload else []
            if address is not None and any(one.get("file") == TRAIL for one in files):
                self._drawing.add(address.identity.base)

    def _mine(self, robot: RobotView) -> bool:
        return self._visitors.free(robot, time.monotonic())

    # -- the operator's thread

    def _run(self, yours: str) -> None:
        robots = self.discovery.all_robots()
        with suppress(EndedEarlyError):
            scripted = [robot.base for robot in robots if robot.offers("autonomy")]
            self._until(lambda: self._drawing.issuperset(scripted), _LISTED_S)
            while not (yours and self.rounds):
                self._show_trails(robots)
                for step in SCRIPT:
                    self._begin(step.name, robots)
                    self._perform(step)
                if not self.rounds:
                    self.until_right(EMERGENCY_STOP, partial(self._stop_all, robots))
                    self.until_right(BY_ITSELF, partial(self._take_over, robots))
                self.rounds += 1
            self.steering.release()
            self._doing = yours
            while True:
                self._show_trails(robots)
                self._wait(_TRAIL_S)
        self._begin("disconnecting", robots)
        self._drive(STOP)

    def until_right(self, name: str, act: Callable[[], None]) -> None:
        """Once, and again while its assessment leaves ``name`` in ``again``."""
        for _ in range(_MOST_TIMES):
            act()
            self._until(lambda: not self.completed, _ASSESSED_S)
            if name not in self.again:
                return

    def _begin(self, step: str, robots: Sequence[RobotView]) -> None:
        """Chooses among those that are free."""
        self._doing = step
        self.steering.release()
        self._visitors.begin_step(time.monotonic())
        self._robots = [robot for robot in robots if self._mine(robot)]

    def _complete(self, *completed: CompletedStep | CompletedStop | CompletedFollow) -> None:
        """Those of robots that are still free."""
        mine = {robot.name for robot in self._robots if self._mine(robot)}
        self.completed.extend(one for one in completed if one.robot in mine)

    def _wait(self, seconds: float) -> None:
        if self._stopping.wait(seconds) or (self._scripted is not None and not self._mine(self._scripted)):
            raise EndedEarlyError

    def _until(self, condition: Callable[[], bool], timeout: float, steady_s: float = 0.0) -> None:
        """Wait until the condition has held for ``steady_s``, at most for ``timeout``."""
        since = time.monotonic()
        end = since + timeout
        while (now := time.monotonic()) < end:
            since = since if condition() else now
            if since < now - steady_s:
                return
            self._wait(_POLL_S)

    def _drive(self, drive: Drive) -> float:
        """Send one command to all robots that are free; returns when."""
        for robot in filter(self._mine, self._robots):
            self.steering.drive(robot, drive, time.monotonic())
        return time.monotonic()

    def _hold(self, drive: Drive, seconds: float) -> float:
        """Send a command again and again, as a held stick does; returns when it was last sent."""
        self.steering.take(filter(self._mine, self._robots), self._until)
        began = due = sent = time.monotonic()
        while due < began + seconds:
            sent = self._drive(drive)
            due += COMMAND_PERIOD_S
            self._wait(max(0.0, due - sent))
        return sent

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._publish_all([Message(topic, payload, QoS.DELIVERED)])

    def _publish_all(self, messages: Iterable[Message]) -> None:
        for one in messages:
            if one.topic.endswith(DRIVE.suffix):  # the zeros of an emergency stop are among them
                self._visitors.note_sent(one.topic, one.payload)
            self._transport.publish(one.topic, one.payload, qos=one.qos, urgent=True)

    # -- a step, an emergency stop, and a script

    def _perform(self, step: Step) -> None:
        began, flash = time.monotonic(), isinstance(step.lights, LightsFlash)
        lights = codec.encode(contract.LIGHTS_FLASH if flash else contract.LIGHTS_SOLID, step.lights)
        for robot in self._robots:
            self._publish(robot.lights_topic(flash=flash), lights)
        released = self._hold(step.drive, step.drive_s)
        if step.sends_stop:
            released = self._drive(STOP)
        self._doing = f"{step.name}{OBSERVING}"
        self._wait(step.rest_s)
        ended = time.monotonic()
        self._complete(*(CompletedStep(robot.name, step, began, released, ended) for robot in self._robots))

    def _stop_all(self, robots: Sequence[RobotView]) -> None:
        """Drive all, stop them, drive in vain, reset, drive again; a stop by a person is the person's to reset."""
        received, began = queue.SimpleQueue[Message](), time.monotonic()
        self._begin(EMERGENCY_STOP, robots)
        self._end_trails()
        with closing(self._transport.subscribe(ALL_OUTGOING, received.put)):  # brings retained capabilities again
            self._hold(_FORWARD, _BEFORE_S)
            pressed = time.monotonic()
            bases = [robot.base for robot in self._robots]
            sender = StopSender(new_name(), by=NAME, why="part of the demo", now=pressed, robots=bases)
            while not sender.confirmed and time.monotonic() < pressed + _CONFIRMED_S:
                self._publish_all(sender.tick(time.monotonic()))
                self._hold(_FORWARD, COMMAND_PERIOD_S)
                while not received.empty():
                    sender.receive(received.get(), time.monotonic())
        self._hold(_FORWARD, _IN_VAIN_S)
        mine = [robot for robot in self._robots if robot.stopped_by is None or robot.stopped_by.by == NAME]
        reset_at, resets = time.monotonic(), {robot: Reset(robot.estop, NAME) for robot in mine}
        for reset in resets.values():
            self._publish_all(reset.messages())
        self._wait(_RESET_S)
        self._hold(_FORWARD, _AFTER_S)
        ended = self._drive(STOP)
        self._wait(_STOPPED_REST_S)
        for robot, reset in resets.items():
            confirmed_s, free = sender.robots[robot.base].confirmed_s, bool(reset.shown) and reset.free
            self._complete(CompletedStop(robot.name, began, pressed, confirmed_s, reset_at, free, ended))

    def _show_trails(self, robots: Sequence[RobotView]) -> None:
        """Have each robot with the script for it publish where it is, if it runs no other.

        One that is stopped, or was driven a moment ago, refuses to start a script.
        """
        now = time.monotonic()
        for robot in [one for one in robots if one.base in self._drawing]:
            runs = robot.autonomy is not None and robot.autonomy.running
            if not runs and not robot.stopped_by and self._visitors.rests(robot, now):
                self._command(robot, AutonomyCommand(action="start", file=TRAIL))

    def _end_trails(self) -> None:
        """So that an emergency stop ends no script, which would be told of as a failure."""
        for robot in self._robots:
            if robot.autonomy is not None and robot.autonomy.running and robot.autonomy.file == TRAIL:
                self._command(robot, AutonomyCommand(action="stop"))

    def _command(self, robot: RobotView, command: AutonomyCommand) -> None:
        self._publish(AUTONOMY_COMMAND.topic(robot.base), codec.encode(AUTONOMY_COMMAND, command))

    def _take_over(self, robots: Sequence[RobotView]) -> None:
        """Let each robot with scripts follow a tag, and overrule the script for a moment."""
        for robot in [robot for robot in robots if robot.offers("autonomy")]:
            self._begin("scripts", [robot])
            self._scripted = robot
            with suppress(EndedEarlyError):
                self._wait(0.0)
                if BY_ITSELF in self.again:  # away from the tag before which it arrived, for a way to drive
                    self._hold(_BACK_OFF, _BACK_OFF_S)
                    self._drive(STOP)
                self._complete(self._follow(robot))
            self._scripted = None
            self._wait(0.0)

    def _follow(self, robot: RobotView) -> CompletedFollow:
        """Start the script, drive for a moment, and wait until it has arrived. Failures are for the assessment."""
        seen: deque[TagData] = deque(maxlen=1)

        def receive(message: Message) -> None:
            with suppress(PayloadError):
                seen.append(codec.decode(APRILTAG_DATA, message.payload))

        def scripted() -> bool:
            """Whether the robot reports that no person goes before its script, as after the steps before."""
            status = robot.autonomy
            return status is not None and status.running and status.overridden is not True

        def distance_m() -> float:
            """From the tag; infinite if the robot does not see it."""
            return math.inf if not seen or seen[0].distance_m is None else seen[0].distance_m

        self.show(f"STARTS: {FOLLOW}, {robot.name} plays {CLIP} and drives to tag {TAG_ID} by itself")
        config = {"tag_id": TAG_ID, "tag_size_m": TAG_SIZE_M, "target_distance_m": DISTANCE_M}
        sound = codec.encode(SOUNDBOARD_COMMAND, SoundboardCommand(action="play", file=CLIP))
        with ExitStack() as stack:
            stack.callback(self._transport.subscribe(APRILTAG_DATA.topic(robot.base), receive).close)
            stack.callback(self._command, robot, AutonomyCommand(action="stop"))
            began = time.monotonic()
            self._command(robot, AutonomyCommand(action="start", file=FOLLOW, config=config))
            self._publish(SOUNDBOARD_COMMAND.topic(robot.base), sound)
            self._until(lambda: bool(seen) and scripted(), _START_S)
            self._wait(_APPROACH_S)
            self.show(f"TAKES OVER: drives {robot.name}, {FOLLOW} is overruled")
            took_over = time.monotonic()
            self._hold(_BACK, _OVERRIDE_S)
            released = self._drive(STOP)
            self.show(f"LETS GO: {robot.name} waits {HOLD_S:.0f} s for another command")
            self._until(scripted, HOLD_S + _STATUS_S)
            self.show(f"GIVES BACK: {FOLLOW} drives {robot.name} again")
            self._until(lambda: abs(distance_m() - DISTANCE_M) <= TOLERANCE_M, _ARRIVAL_S, _STEADY_S)
            self.show(f"ENDS: {FOLLOW}, {robot.name} sees tag {TAG_ID} at {distance_m():.2f} m")
            ended = time.monotonic()
        self._wait(_FOLLOWED_REST_S)
        return CompletedFollow(robot.name, began, took_over, wheels_of(_BACK), released, ended, CLIP)
