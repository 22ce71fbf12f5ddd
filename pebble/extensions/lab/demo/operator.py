"""A scripted operator of a broker's robots: it drives them in steps, stops them all, and overrules a script.

It yields to people: a robot that another person drives, or has stopped, is left alone until the next step. Times are
seconds of time.monotonic().
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing, suppress
from typing import NamedTuple

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import AutonomyCommand, Drive, LightsFlash, LightsSolid, SoundboardCommand, TagData
from pebble.errors import PayloadError
from pebble.extensions.lab.demo.outcome import Driven, Wheels
from pebble.extensions.lab.demo.visitors import Visitors
from pebble.extensions.lab.rig.scripted_operator import ScriptedOperator, paced
from pebble.extensions.lab.rig.testbed import CLIP, TAG_ID
from pebble.extensions.operator.client.discovery import ALL_OUTGOING, Discovery
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.motion.arbiter import HOLD_MS
from pebble.transports import Message, MqttSettings, QoS, create

NAME = "demo-operator"
STOP = Drive()
_POLL_S = 0.02
_MOST_WAITING = 1000  # events and completed steps; beyond them the oldest is dropped


def wheels_of(drive: Drive) -> Wheels:
    """Return the wheel speeds of a command, which in the demo never exceeds full speed."""
    return drive.z + drive.x, drive.z - drive.x


class Step(NamedTuple):
    """A command that is repeated for ``drive_s``; then, for ``rest_s``, a stop or no command."""

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

EMERGENCY_STOP = "emergency stop"  # of all robots, which are driven in vain
AFTER_RESET = "after the reset"  # they can be driven again
_BEFORE_S, _IN_VAIN_S, _RESET_S, _AFTER_S, _STOPPED_REST_S = 0.8, 1.0, 0.8, 0.6, 0.8
EMERGENCY_S = _BEFORE_S + _IN_VAIN_S + _RESET_S + _AFTER_S + _STOPPED_REST_S + 0.5
_CONFIRMED_S = 3.0  # until every robot has confirmed, on the smallest machine
_CONTROL_S = 1.0  # until every robot has given it
_AGAIN_S = 0.05  # until the operator looks whether a stop is confirmed
_FORWARD = Drive(z=0.5)

TAKE_OVER = "take over"  # a robot follows a tag by a script, and is driven for a moment in between
FOLLOW = "apriltag-follow"
TRAIL = c.WHEEL_ODOMETRY.metric  # the script of this name; it draws the map of the operator page
TAG_SIZE_M = 0.25
DISTANCE_M, TOLERANCE_M = 1.3, 0.05
HOLD_S = HOLD_MS / 1000  # scripts are refused this long after a person's last command
_APPROACH_S, _OVERRIDE_S, _STEADY_S, _FOLLOWED_REST_S = 1.0, 1.0, 0.8, 0.5
_START_S, _ARRIVAL_S = 10.0, 10.0  # at most, on the smallest machine
_STATUS_S = 1.0  # until the robot's status has changed
_LISTED_S = 20.0  # until a robot has listed its scripts, on the smallest machine
_TRAIL_S = 3.0  # until a script that was started runs
#: Of most runs; a slow one takes longer.
TAKEOVER_S = 2.0 + _APPROACH_S + _OVERRIDE_S + HOLD_S + 4.5 + _STEADY_S + _FOLLOWED_REST_S
_BACK = Drive(x=-0.1, z=-0.5)
_BEFORE_SCRIPT_S = 0.2  # before the script drives again

FIRST_ROUND_S = ROUND_S + EMERGENCY_S + TAKEOVER_S
STEPS = (*(step.name for step in SCRIPT), EMERGENCY_STOP, AFTER_RESET)  # of every robot, in the first round


class EndedEarlyError(Exception):
    """An error that ends a step: the demo ends, or a person has taken the robot that runs a script."""


class Operator:
    """The demo's driver, with a thread and a connection of its own.

    ``activity`` and ``events`` (seconds and a line) are for display. ``visitors`` notes the robots that people take.
    ``completed`` collects the commands that were driven. The emergency stop and the script belong to the first round.
    """

    def __init__(self, port: int) -> None:
        self.discovery = Discovery()
        self.rounds = 0
        self.events: deque[tuple[float, str]] = deque(maxlen=_MOST_WAITING)
        self.completed: deque[Driven] = deque(maxlen=_MOST_WAITING)
        self._step = "discovering robots"  # the present one
        self.visitors = Visitors(NAME)
        self.drivers: dict[str, ScriptedOperator] = {}  # by base topic
        self._with_trail: set[str] = set()  # base topics of robots that have listed the script TRAIL
        self._robots: list[RobotView] = []  # that take part in the present step
        self._scripted: RobotView | None = None  # if a person takes it, the present step ends
        self._transport = create("mqtt", NAME, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread()

    def connect(self) -> None:
        """Connect and subscribe, without waiting."""
        self._transport.open(timeout=0.0)
        self._transport.subscribe(
            ALL_OUTGOING, lambda message: self.discovery.receive(message, time.monotonic(), time.time())
        )
        drives = c.DRIVE.filter("+/+/+")
        self._transport.subscribe(drives, lambda message: self.visitors.receive_drive(message, time.monotonic()))
        self._transport.subscribe(c.AUTONOMY_FILES.filter("+/+/+"), self._receive_scripts)

    def not_ready(self, names: Iterable[str]) -> list[str]:
        """Return the names of robots that cannot be driven yet."""
        ready = [robot.name for robot in self.discovery.all_robots() if robot.ready(time.monotonic())]
        return [name for name in names if name not in ready]

    def show(self, event: str) -> None:
        self._step = event
        self.events.append((time.monotonic(), f"operator {event}"))

    @property
    def activity(self) -> str:
        """The present step, with the robots that it leaves alone."""
        robots, now = self.discovery.all_robots(), time.monotonic()
        others = [f"{robot.name} {why}" for robot in robots if (why := self.visitors.taken(robot, now))]
        return "; ".join([self._step, *others])

    def begin(self, invitation: str = "") -> None:
        """Start driving all robots discovered so far, round after round.

        With ``invitation`` drive one round, then show this text in place of a step.
        """
        self._thread = threading.Thread(target=self._run, args=(invitation,), name="operator", daemon=True)
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
            files = codec.decode(c.AUTONOMY_FILES, message.payload).files if message.payload else []
            if address is not None and any(script.get("file") == TRAIL for script in files):
                self._with_trail.add(address.identity.base)

    def _is_free(self, robot: RobotView) -> bool:
        return self.visitors.free(robot, time.monotonic())

    # -- the operator's thread

    def _run(self, invitation: str) -> None:
        """Drive round after round; with ``invitation`` one round, then show it. At the end leave the robots at rest."""
        robots = self.discovery.all_robots()
        with suppress(EndedEarlyError):
            with_scripts = [robot.base for robot in robots if robot.offers("autonomy")]
            self._until(lambda: self._with_trail.issuperset(with_scripts), _LISTED_S)
            while not (invitation and self.rounds):  # without an invitation until the demo ends
                self._show_trails(robots)
                for step in SCRIPT:
                    self._begin(step.name, robots)
                    self._perform(step)
                if not self.rounds:
                    self._stop_all(robots)
                    self._take_over(robots)
                self.rounds += 1
            self._release()
            self._step = invitation
            while True:  # until the demo ends
                self._show_trails(robots)
                self._wait(_TRAIL_S)
        self._begin("disconnecting", robots)
        self._drive(STOP)

    def _begin(self, step: str, robots: Sequence[RobotView]) -> None:
        """Begin a step with those of the robots that are free."""
        self._step = step
        self._release()
        self.visitors.begin_step(time.monotonic())
        self._robots = [robot for robot in robots if self._is_free(robot)]

    def _complete(self, step: str, drive: Drive, began: float, released: float, ended: float) -> None:
        """Note the command of this step for each robot that is still free."""
        for robot in filter(self._is_free, self._robots):
            self.completed.append(Driven(robot.name, step, wheels_of(drive), began, released, ended))

    def _wait(self, seconds: float) -> None:
        """Wait. Raises EndedEarlyError if the demo ends, or if a person has taken the robot that runs a script."""
        if self._stopping.wait(seconds) or (self._scripted is not None and not self._is_free(self._scripted)):
            raise EndedEarlyError

    def _until(self, condition: Callable[[], bool], timeout: float, steady_s: float = 0.0) -> None:
        """Wait, at most ``timeout``, until the condition has held for ``steady_s``."""
        false_at = time.monotonic()  # when the condition was last false
        end = false_at + timeout
        while (now := time.monotonic()) < end:
            if not condition():
                false_at = now
            if now - false_at > steady_s:
                return
            self._wait(_POLL_S)

    def _drive(self, drive: Drive) -> float:
        """Send a command to all robots that are free; return the time."""
        for driver in self._free_drivers():
            driver.command(drive)
        return time.monotonic()

    def _hold(self, drive: Drive, seconds: float) -> float:
        """Repeat a command, as a held stick does; return the time when it was last sent."""
        self._take_control()
        sent = time.monotonic()
        for _ in paced(seconds, wait=self._wait):
            sent = self._drive(drive)
        return sent

    def _free_drivers(self) -> list[ScriptedOperator]:
        return [self._driver(robot) for robot in self._robots if self._is_free(robot)]

    def _driver(self, robot: RobotView) -> ScriptedOperator:
        if robot.base not in self.drivers:
            driver = ScriptedOperator(robot, self._publish_message, by=NAME, device="demo")
            self.visitors.own_ids.add(driver.control.id)
            self.drivers[robot.base] = driver
        return self.drivers[robot.base]

    def _take_control(self) -> None:
        """Ask for control of all robots that are free, as a person would."""
        drivers = self._free_drivers()

        def have_control() -> bool:
            for driver in drivers:
                driver.tick()
            return all(driver.has_control for driver in drivers)

        for driver in drivers:
            driver.ask_control()
        self._until(have_control, _CONTROL_S)
        for driver in drivers:
            if not driver.has_control:  # a person was faster
                driver.release()

    def _release(self) -> None:
        for driver in self.drivers.values():
            driver.release()

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._publish_message(Message(topic, payload, QoS.DELIVERED))

    def _publish_message(self, message: Message) -> None:
        if message.topic.endswith(c.DRIVE.suffix):  # the zeros of an emergency stop are among them
            self.visitors.note_sent(message.topic, message.payload)
        self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    # -- a step, an emergency stop, and a script

    def _perform(self, step: Step) -> None:
        """Set the lights of all robots, drive them for a while, and let them rest."""
        began = time.monotonic()
        channel = c.LIGHTS_FLASH if isinstance(step.lights, LightsFlash) else c.LIGHTS_SOLID
        lights = codec.encode(channel, step.lights)
        for robot in self._robots:
            self._publish(robot.topic(channel), lights)
        released_at = self._hold(step.drive, step.drive_s)
        if step.sends_stop:
            released_at = self._drive(STOP)  # a zero, sent now: from then on they must rest
        self._wait(step.rest_s)
        self._complete(step.name, step.drive, began, released_at, time.monotonic())

    def _stop_all(self, robots: Sequence[RobotView]) -> None:
        """Drive all, stop them, try to drive, reset, drive again. A person's stop is left to the person."""
        began = time.monotonic()
        self._begin(EMERGENCY_STOP, robots)
        self._end_trails()
        self._hold(_FORWARD, _BEFORE_S)
        pressed = time.monotonic()
        drivers = [self._driver(robot) for robot in self._robots]

        def receive(message: Message) -> None:
            for driver in drivers:
                driver.receive(message)

        for driver in drivers:
            driver.stop("part of the demo")
        # A new subscription also brings the retained capabilities, which say whose confirmations a stop needs.
        with closing(self._transport.subscribe(ALL_OUTGOING, receive)):
            while not all(driver.stopped for driver in drivers) and time.monotonic() < pressed + _CONFIRMED_S:
                self._hold(_FORWARD, _AGAIN_S)  # in vain; each command also sends the stop again when that is due
        self._hold(_FORWARD, _IN_VAIN_S)  # after the confirmations: the motors must stay off
        reset_at = time.monotonic()
        self._complete(EMERGENCY_STOP, _FORWARD, began, pressed, reset_at)
        for driver in drivers:
            driver.reset()
        self._wait(_RESET_S)
        self._hold(_FORWARD, _AFTER_S)
        released = self._drive(STOP)
        self._wait(_STOPPED_REST_S)
        self._complete(AFTER_RESET, _FORWARD, reset_at, released, time.monotonic())

    def _show_trails(self, robots: Sequence[RobotView]) -> None:
        """Start the script that publishes the position, on each robot that has this script and runs none.

        A robot that is stopped, or was driven a moment ago, refuses to start a script.
        """
        now = time.monotonic()
        for robot in [candidate for candidate in robots if candidate.base in self._with_trail]:
            runs = robot.autonomy is not None and robot.autonomy.running
            if not runs and not robot.stopped_by and self.visitors.rests(robot, now):
                self._command(robot, AutonomyCommand(action="start", file=TRAIL))

    def _end_trails(self) -> None:
        """End the scripts that _show_trails started, because an emergency stop would end them as a failure."""
        for robot in self._robots:
            if robot.autonomy is not None and robot.autonomy.running and robot.autonomy.file == TRAIL:
                self._command(robot, AutonomyCommand(action="stop"))

    def _command(self, robot: RobotView, command: AutonomyCommand) -> None:
        self._publish(c.AUTONOMY_COMMAND.topic(robot.base), codec.encode(c.AUTONOMY_COMMAND, command))

    def _take_over(self, robots: Sequence[RobotView]) -> None:
        """Let each robot with scripts follow a tag, and overrule the script for a moment."""
        for robot in [robot for robot in robots if robot.offers("autonomy")]:
            self._begin("scripts", [robot])
            self._scripted = robot
            with suppress(EndedEarlyError):  # a person has taken it: go on with the next robot
                self._wait(0.0)  # raises if a person has it already
                self._follow(robot)
            self._scripted = None
            self._wait(0.0)  # raises if the demo ends

    def _follow(self, robot: RobotView) -> None:
        """Start the script, drive in its place for a moment, and wait until it has brought the robot to the tag."""
        tags: deque[TagData] = deque(maxlen=1)

        def receive(message: Message) -> None:
            with suppress(PayloadError):
                tags.append(codec.decode(c.APRILTAG_DATA, message.payload))

        def script_drives() -> bool:
            """True if the robot reports that its script runs and no person drives in place of it."""
            status = robot.autonomy
            return status is not None and status.running and status.overridden is not True

        def distance_m() -> float:
            """Return the robot's distance from the tag; infinite if the robot does not see the tag."""
            return math.inf if not tags or tags[0].distance_m is None else tags[0].distance_m

        self.show(f"STARTS: {FOLLOW}, {robot.name} plays {CLIP} and drives to tag {TAG_ID} by itself")
        config = {"tag_id": TAG_ID, "tag_size_m": TAG_SIZE_M, "target_distance_m": DISTANCE_M}
        sound = codec.encode(c.SOUNDBOARD_COMMAND, SoundboardCommand(action="play", file=CLIP))
        with ExitStack() as stack:
            stack.callback(self._transport.subscribe(c.APRILTAG_DATA.topic(robot.base), receive).close)
            stack.callback(self._command, robot, AutonomyCommand(action="stop"))
            self._command(robot, AutonomyCommand(action="start", file=FOLLOW, config=config))
            self._publish(c.SOUNDBOARD_COMMAND.topic(robot.base), sound)
            self._until(lambda: bool(tags) and script_drives(), _START_S)
            self._wait(_APPROACH_S)
            self.show(f"TAKES OVER: drives {robot.name}, {FOLLOW} is overruled")
            took_over = time.monotonic()
            self._hold(_BACK, _OVERRIDE_S)
            released = self._drive(STOP)
            self.show(f"LETS GO: {robot.name} waits {HOLD_S:.0f} s for another command")
            self._wait(HOLD_S - _BEFORE_SCRIPT_S)  # the record of the command ends while nothing moves the robot
            self._complete(TAKE_OVER, _BACK, took_over, released, time.monotonic())
            self._until(script_drives, _STATUS_S)
            self.show(f"GIVES BACK: {FOLLOW} drives {robot.name} again")
            self._until(lambda: abs(distance_m() - DISTANCE_M) <= TOLERANCE_M, _ARRIVAL_S, _STEADY_S)
            self.show(f"ENDS: {FOLLOW}, {robot.name} sees tag {TAG_ID} at {distance_m():.2f} m")
        self._wait(_FOLLOWED_REST_S)
