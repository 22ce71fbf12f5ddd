"""What the scripted operator does: steps of driving, an emergency stop, and a script that it overrules for a moment."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial

from pebble.client.discovery import ALL_OUTGOING, DiscoveredRobot
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset
from pebble.contract import APRILTAG_DATA, AUTONOMY_COMMAND, SOUNDBOARD_COMMAND, Channel, codec
from pebble.contract.payloads import AutonomyCommand, Drive, LightsFlash, LightsSolid, SoundboardCommand, TagData
from pebble.errors import PayloadError
from pebble.motion.arbiter import HOLD_MS
from pebble.services.serial_mcu_bridge.text.goob_base import mix
from pebble.transports import Message, QoS, Transport

COMMAND_PERIOD_S = 0.05  # how often a held stick is repeated
_POLL_S = 0.02

Wait = Callable[[float], None]
"""Waits for so many seconds. Raises EndedEarlyError."""

Send = Callable[[Drive], None]
"""Sends a drive command to one robot, or to all that take part."""

Wheels = tuple[float, float]  # left and right, -1..1


class EndedEarlyError(Exception):
    """The demo ends, or a person has taken the robot."""


# -- driving


@dataclass(frozen=True, slots=True)
class Step:
    """Repeat ``drive`` for ``drive_s``, then send a stop or simply nothing more, and observe for ``rest_s``."""

    name: str
    drive: Drive
    drive_s: float
    sends_stop: bool
    rest_s: float
    lights: LightsSolid | LightsFlash


@dataclass(frozen=True, slots=True)
class CompletedStep:
    """A step that was sent to one robot. Times are time.monotonic() of the operator."""

    robot: str  # its id
    step: Step
    began: float
    released: float  # the last moving command, or the stop command if the step sends one
    ended: float


SCRIPT = (
    Step("forward, stop", Drive(z=0.6), 1.2, True, 1.4, LightsSolid(g=1.0)),
    Step("turn right, stop", Drive(x=0.35), 0.8, True, 1.4, LightsFlash(b=1.0, period=0.5)),
    Step("forward, let go", Drive(z=0.6), 0.8, False, 1.4, LightsSolid(r=1.0)),
    Step("back, stop", Drive(z=-0.5), 0.8, True, 1.4, LightsSolid(b=0.3, g=0.3, r=0.3)),
)
ROUND_S = sum(step.drive_s + step.rest_s for step in SCRIPT)


def repeat(send: Callable[[], None], wait: Wait, seconds: float) -> float:
    """Send a drive command again and again, as a held stick does; returns when it was last sent (monotonic)."""
    began = due = sent = time.monotonic()
    while due < began + seconds:
        send()
        sent = time.monotonic()
        due += COMMAND_PERIOD_S
        wait(max(0.0, due - sent))
    return sent


# -- all robots are stopped, driven in vain, and reset


EMERGENCY_STOP = "emergency stop"
_BEFORE_S, _IN_VAIN_S, _RESET_S, _AFTER_S, _STOPPED_REST_S = 0.8, 1.0, 0.8, 0.6, 0.8
EMERGENCY_S = _BEFORE_S + _IN_VAIN_S + _RESET_S + _AFTER_S + _STOPPED_REST_S + 0.5
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


def emergency_stop(
    transport: Transport, robots: Sequence[DiscoveredRobot], drive: Send, wait: Wait, by: str
) -> list[CompletedStop]:
    """Drive all robots, stop them, drive in vain, reset, drive again; a stop by a person is the person's to reset."""
    received: queue.SimpleQueue[Message] = queue.SimpleQueue()
    forward = partial(drive, _FORWARD)

    def publish(messages: Sequence[Message]) -> None:
        for message in messages:
            transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    def take() -> None:
        while not received.empty():
            sender.receive(received.get(), time.monotonic())

    with closing(transport.subscribe(ALL_OUTGOING, received.put)):  # brings retained capabilities again
        repeat(forward, wait, _BEFORE_S)
        pressed = time.monotonic()
        bases = [robot.base for robot in robots]
        sender = StopSender(new_name(), by=by, why="part of the demo", now=pressed, robots=bases)
        while not sender.confirmed and time.monotonic() < pressed + _CONFIRMED_S:
            publish(sender.tick(time.monotonic()))
            forward()
            wait(COMMAND_PERIOD_S)
            take()
        sender.end()
        repeat(forward, wait, _IN_VAIN_S)
        take()
        stops = {robot.name: sender.robots[robot.base] for robot in robots}
        others = [name for name, stop in stops.items() if (held := stop.estop.stopped_by) and held.by != by]
        resets = {name: Reset(stop.estop, by) for name, stop in stops.items() if name not in others}
        reset_at = time.monotonic()
        for reset in resets.values():
            publish(reset.messages())
        wait(_RESET_S)
        repeat(forward, wait, _AFTER_S)
        drive(Drive())
        ended = time.monotonic()
        wait(_STOPPED_REST_S)
        take()
    return [
        CompletedStop(name, pressed, stops[name].confirmed_s, reset_at, bool(reset.shown) and reset.free, ended)
        for name, reset in resets.items()
    ]


# -- a script on a robot, which is driven for a moment in between


BY_ITSELF = "by itself"
FOLLOW = "apriltag-follow"
TAG_ID, TAG_SIZE_M = 21, 0.25  # of the tag that Goob follows, as in the world file
CLIP = "horn.wav"
DISTANCE_M, TOLERANCE_M = 0.9, 0.05
HOLD_S = HOLD_MS / 1000  # scripts are refused this long after a person's last command
_APPROACH_S, _OVERRIDE_S, _STEADY_S, _FOLLOWED_REST_S = 1.0, 1.0, 0.8, 0.5
_START_S, _ARRIVAL_S = 10.0, 10.0  # at most, on the smallest machine
_STATUS_S = 1.0  # until the robot's status has changed
#: Of most runs; a slow one takes longer.
TAKEOVER_S = 2.0 + _APPROACH_S + _OVERRIDE_S + HOLD_S + 4.5 + _STEADY_S + _FOLLOWED_REST_S
_BACK = Drive(x=-0.1, z=-0.5)


@dataclass(frozen=True, slots=True)
class CompletedFollow:
    """What the operator did. Times are time.monotonic() of the operator."""

    robot: str  # its id
    started: float  # the script
    took_over: float  # first drive command
    wheels: Wheels  # of the operator's drive commands
    released: float  # the zero after them
    ended: float  # the script, by a stop command
    clip: str

    @property
    def began(self) -> float:
        return self.started


class TakeOver:
    """One script on one robot, on the operator's thread; ``note(what, text)`` shows what the operator does."""

    def __init__(
        self, transport: Transport, robot: DiscoveredRobot, drive: Send, wait: Wait, note: Callable[[str, str], None]
    ) -> None:
        self._transport, self._robot = transport, robot
        self._drive, self._wait, self._note = drive, wait, note
        self._seen: TagData | None = None
        self._away_at = 0.0  # when the tag was last not at the wanted distance

    def perform(self) -> CompletedFollow:
        """The script is ended in any case; what goes wrong is for the assessment."""
        subscription = self._transport.subscribe(APRILTAG_DATA.topic(self._robot.base), self._receive)
        try:
            completed = self._follow()
        finally:
            subscription.close()
            self._publish(AUTONOMY_COMMAND, AutonomyCommand(action="stop"))
        self._wait(_FOLLOWED_REST_S)
        return completed

    def _follow(self) -> CompletedFollow:
        name = self._robot.name
        self._note("PLAYS", f"{CLIP} on {name}")
        self._note("STARTS", f"{FOLLOW}, {name} drives to tag {TAG_ID} by itself")
        config = {"tag_id": TAG_ID, "tag_size_m": TAG_SIZE_M, "target_distance_m": DISTANCE_M}
        started = time.monotonic()
        self._publish(AUTONOMY_COMMAND, AutonomyCommand(action="start", file=FOLLOW, config=config))
        self._publish(SOUNDBOARD_COMMAND, SoundboardCommand(action="play", file=CLIP))
        self._until(lambda: self._seen is not None and not self._overruled, _START_S)
        self._wait(_APPROACH_S)
        self._note("TAKES OVER", f"drives {name}, {FOLLOW} is overruled")
        took_over = time.monotonic()
        repeat(partial(self._drive, _BACK), self._wait, _OVERRIDE_S)
        self._drive(Drive())
        released = time.monotonic()
        self._note("LETS GO", f"{name} waits {HOLD_S:.0f} s for another command")
        self._until(lambda: not self._overruled, HOLD_S + _STATUS_S)
        self._note("GIVES BACK", f"{FOLLOW} drives {name} again")
        self._away_at = time.monotonic()
        self._until(self._arrived, _ARRIVAL_S)
        distance = "does not see tag {}" if self._distance_m is None else "sees tag {} at {:.2f} m"
        self._note("ENDS", f"{FOLLOW}, {name} {distance.format(TAG_ID, self._distance_m)}")
        return CompletedFollow(name, started, took_over, mix(_BACK.x, _BACK.z), released, time.monotonic(), CLIP)

    @property
    def _distance_m(self) -> float | None:
        return None if self._seen is None else self._seen.distance_m

    def _arrived(self) -> bool:
        """The tag has been at the wanted distance for a while."""
        if self._distance_m is None or abs(self._distance_m - DISTANCE_M) > TOLERANCE_M:
            self._away_at = time.monotonic()
        return time.monotonic() - self._away_at >= _STEADY_S

    @property
    def _overruled(self) -> bool:
        """Whether the robot reports that a person goes before its script, as after the steps before."""
        status = self._robot.autonomy
        return status is None or not status.running or status.overridden is True

    def _until(self, condition: Callable[[], bool], timeout: float) -> None:
        """Wait for ``condition`` at most that long."""
        end = time.monotonic() + timeout
        while not condition() and time.monotonic() < end:
            self._wait(_POLL_S)

    def _publish(self, channel: Channel, payload: AutonomyCommand | SoundboardCommand) -> None:
        topic = channel.topic(self._robot.base)
        self._transport.publish(topic, codec.encode(channel, payload), qos=QoS.DELIVERED, urgent=True)

    # -- the transport's thread

    def _receive(self, message: Message) -> None:
        with suppress(PayloadError):  # the assessment notices if there is no other
            self._seen = codec.decode(APRILTAG_DATA, message.payload)
