"""The scripted operator starts a script on a robot, drives the robot for a moment in between, and gives it back."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from pebble.client.discovery import DiscoveredRobot
from pebble.contract import APRILTAG_DATA, AUTONOMY_COMMAND, SOUNDBOARD_COMMAND, Channel, codec
from pebble.contract.payloads import AutonomyCommand, Drive, SoundboardCommand, TagData
from pebble.errors import PayloadError
from pebble.motion.arbiter import HOLD_MS
from pebble.rig.room import CLIP, TAG_ID, TAG_SIZE_M
from pebble.rig.steps import repeat
from pebble.services.serial_mcu_bridge.text.goob_base import mix
from pebble.transports import Message, QoS, Transport

NAME = "by itself"
SCRIPT = "apriltag-follow"
DISTANCE_M, TOLERANCE_M = 0.9, 0.05
HOLD_S = HOLD_MS / 1000  # scripts are refused this long after a person's last command
_APPROACH_S, _OVERRIDE_S, _STEADY_S, _REST_S = 1.0, 1.0, 0.8, 0.5
_START_S, _ARRIVAL_S = 10.0, 10.0  # at most, on the smallest machine
_STATUS_S = 1.0  # until the robot's status has changed
_POLL_S = 0.02
#: Of most runs; a slow one takes longer.
DURATION_S = 2.0 + _APPROACH_S + _OVERRIDE_S + HOLD_S + 4.5 + _STEADY_S + _REST_S
_BACK = Drive(x=-0.1, z=-0.5)


Wheels = tuple[float, float]  # left and right, -1..1


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
    """One script on one robot, on the operator's thread.

    ``drive(axes)`` sends a drive command to the robot, ``wait(seconds)`` returns True if the demo ends, and
    ``note(what, text)`` shows what the operator does.
    """

    def __init__(
        self,
        transport: Transport,
        robot: DiscoveredRobot,
        drive: Callable[[Drive], None],
        wait: Callable[[float], bool],
        note: Callable[[str, str], None],
    ) -> None:
        self._transport, self._robot = transport, robot
        self._drive, self._wait, self._note = drive, wait, note
        self._seen: TagData | None = None

    def perform(self) -> CompletedFollow | None:
        """None if the demo ends meanwhile. The script is ended in any case; what goes wrong is for the assessment."""
        subscription = self._transport.subscribe(APRILTAG_DATA.topic(self._robot.base), self._receive)
        try:
            completed = self._follow()
        finally:
            subscription.close()
            self._publish(AUTONOMY_COMMAND, AutonomyCommand(action="stop"))
        return None if completed is None or self._wait(_REST_S) else completed

    def _follow(self) -> CompletedFollow | None:
        name, started = self._robot.name, self._start()
        if self._until(lambda: self._seen is not None and not self._overruled, _START_S) or self._wait(_APPROACH_S):
            return None
        self._note("TAKES OVER", f"drives {name}, {SCRIPT} is overruled")
        took_over = time.monotonic()
        if repeat(lambda: self._drive(_BACK), self._wait, _OVERRIDE_S):
            return None
        self._drive(Drive())
        released = time.monotonic()
        self._note("LETS GO", f"{name} waits {HOLD_S:.0f} s for another command")
        if self._until(lambda: not self._overruled, HOLD_S + _STATUS_S):
            return None
        self._note("GIVES BACK", f"{SCRIPT} drives {name} again")
        if self._until(self._arrival(), _ARRIVAL_S):
            return None
        self._note("ENDS", f"{SCRIPT}, {name} {self._place()}")
        return CompletedFollow(name, started, took_over, mix(_BACK.x, _BACK.z), released, time.monotonic(), CLIP)

    def _start(self) -> float:
        """Start the script and a clip; returns when."""
        self._note("PLAYS", f"{CLIP} on {self._robot.name}")
        self._note("STARTS", f"{SCRIPT}, {self._robot.name} drives to tag {TAG_ID} by itself")
        config = {"tag_id": TAG_ID, "tag_size_m": TAG_SIZE_M, "target_distance_m": DISTANCE_M}
        started = time.monotonic()
        self._publish(AUTONOMY_COMMAND, AutonomyCommand(action="start", file=SCRIPT, config=config))
        self._publish(SOUNDBOARD_COMMAND, SoundboardCommand(action="play", file=CLIP))
        return started

    def _arrival(self) -> Callable[[], bool]:
        """A condition: the tag has been at the wanted distance for a while."""
        since = time.monotonic()

        def arrived() -> bool:
            nonlocal since
            distance = None if self._seen is None else self._seen.distance_m
            if distance is None or abs(distance - DISTANCE_M) > TOLERANCE_M:
                since = time.monotonic()
            return time.monotonic() - since >= _STEADY_S

        return arrived

    @property
    def _overruled(self) -> bool:
        """Whether the robot reports that a person goes before its script, as after the steps before."""
        status = self._robot.autonomy
        return status is None or not status.running or status.overridden is True

    def _place(self) -> str:
        if self._seen is None or self._seen.distance_m is None:
            return f"does not see tag {TAG_ID}"
        return f"sees tag {TAG_ID} at {self._seen.distance_m:.2f} m"

    def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait for ``condition`` at most that long; True if the demo ends."""
        end = time.monotonic() + timeout
        while not condition() and time.monotonic() < end:
            if self._wait(_POLL_S):
                return True
        return False

    def _publish(self, channel: Channel, payload: AutonomyCommand | SoundboardCommand) -> None:
        topic = channel.topic(self._robot.base)
        self._transport.publish(topic, codec.encode(channel, payload), qos=QoS.DELIVERED, urgent=True)

    # -- the transport's thread

    def _receive(self, message: Message) -> None:
        try:
            self._seen = codec.decode(APRILTAG_DATA, message.payload)
        except PayloadError:  # the assessment notices if there is no other
            return
