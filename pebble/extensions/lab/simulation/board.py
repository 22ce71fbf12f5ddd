"""Simulated MCUs on serial lines: bytes in, bytes out, a clock passed in.

They run the firmware of the real boards (``firmware/``) on simulated pins, whose outputs move a simulated body.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.bodies import BoardState, Light, Pair, body_of
from pebble.extensions.lab.simulation.micropython.board import UID, Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.runner import Runner
from pebble.extensions.lab.simulation.motion import RobotMotion

__all__ = ["KINDS", "BoardState", "Light", "Profile", "SimulatedMcu"]

_REPLAYED_S = 0.5  # a pause up to this is replayed turn by turn; output during a longer one is discarded
_TOKENS = 6  # of a line; the rest is ignored
_LONGEST_LINE = 300  # bytes; more than the firmware accepts
_DEADLINES_S = 2.0  # simulated part of a longer pause: all deadlines of the firmware are over by then


@dataclass(frozen=True, slots=True)
class Profile:
    """How to run a board: ``turn_s`` is the period of its firmware's loop, ``tick_s`` that of calling ``tick``."""

    turn_s: float
    tick_s: float
    is_text: bool = True  # its protocol is goob_base_v1


KINDS: Final = {
    "goob": Profile(0.005, 0.02),
    "fred": Profile(0.005, 0.02),
    "goob_imu": Profile(0.0025, 0.005, is_text=False),
}


class SimulatedMcu:
    """One board. Pass host data to ``receive``, call ``tick`` often, and send what both return to the host.

    ``now`` is a monotonic time in seconds from one clock for all calls. ``failsafe_s`` replaces the firmware's own
    limit; ``uid`` is the MCU's unique id; ``motion`` is where the robot stands, and on what ground.
    ``on_motors(now, (left, right))`` is called at each change of the motors, + = forward.
    """

    def __init__(
        self,
        kind: str,
        now: float,
        *,
        failsafe_s: float | None = None,
        charging: bool = False,
        uid: bytes = UID,
        motion: RobotMotion | None = None,
        on_motors: Callable[[float, Pair], None] | None = None,
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"unknown simulated MCU {kind!r}; known: {', '.join(KINDS)}")
        if failsafe_s is not None and not KINDS[kind].is_text:
            raise ConfigError(f"{kind} has no motors and no failsafe")
        self.kind, self.failsafe_s = kind, failsafe_s
        self.profile = KINDS[kind]
        self._clock = VirtualClock(now)
        self.board = Board(self._clock, uid=uid)
        self.body = body_of(kind, self.board, motion)
        self.body.on_motors = on_motors or self.body.on_motors
        self.motion, self.battery = self.body.motion, self.body.battery
        self.battery.charging = charging
        self._boot_output = b""
        self.robot: Any = None  # the firmware's, since the last boot
        self._obeyed = _ObeyedLines(None)
        self._runner = Runner(self.board, kind, None, on_boot=self._on_boot)
        self._start()

    @property
    def resets(self) -> int:
        """How often the board has restarted by itself."""
        return self.board.resets

    def boot(self, now: float) -> None:
        """Press the reset button: pose and battery remain, everything else restarts."""
        self._clock.until(now)
        self._runner.boot()
        self._start()

    def disturb(self, on: bool) -> None:
        """Make every device on the board's I2C bus fail, or work again."""
        self.board.bus.disturbed = on

    def receive(self, data: bytes, now: float) -> bytes:
        """Process ``data``, which may end in the middle of a line. Returns the board's output."""
        output = self._advance(now, self.profile.tick_s)
        if not self.profile.is_text:
            return output + self._write_input(data, now)
        if not self.robot.lines.length:  # the firmware has dropped half a line
            self._obeyed.half = b""
        *lines, rest = data.split(b"\n")
        for line in lines:
            answer = self._write_input(line + b"\n", now)
            self._obeyed.add(line, answer)
            output += answer
        if rest:
            self._obeyed.half = (self._obeyed.half + rest)[:_LONGEST_LINE]
            output += self._write_input(rest, now)
        return output

    def tick(self, now: float) -> bytes:
        """Advance to ``now``. Returns the board's output until then."""
        first, self._boot_output = self._boot_output, b""
        return first + self._advance(now, self.profile.turn_s) + self._turn(now)

    def state(self) -> BoardState:
        drive = self._obeyed.drive(self.board) if self.profile.is_text else None
        return self.body.state(drive, self._obeyed.count, self._obeyed.last.decode("ascii", "replace"))

    # -- time

    def _advance(self, now: float, turn_s: float) -> bytes:
        """Run the loop every ``turn_s`` up to just before ``now``. Returns the board's output."""
        output = b""
        behind = now - self._clock.now()
        if behind <= turn_s:
            return output
        replayed = behind <= _REPLAYED_S
        until = now if replayed else self._clock.now() + _DEADLINES_S
        while (moment := self._clock.now() + turn_s) < min(now, until):
            turned = self._turn(moment)
            output += turned if replayed else b""
        return output

    def _turn(self, now: float) -> bytes:
        """Run one turn of the firmware's loop at ``now``, unless the firmware is still blocked then."""
        if self._clock.now() > now:
            return b""
        self._clock.until(now)
        self._runner.step()
        self.body.end_turn()
        return self.board.take_output()

    def _write_input(self, data: bytes, now: float) -> bytes:
        self.board.type(data)
        output = self._turn(now)
        while (unread := self.board.unread) and self._clock.now() <= now:
            output += self._turn(now)
            if self.board.unread == unread:  # the firmware reads nothing now
                break
        return output

    def _start(self) -> None:
        """Run the first turn; its output belongs to the boot and is no answer to a command."""
        self._runner.step()
        self._boot_output = self.board.take_output()

    def _on_boot(self, robot: Any) -> None:
        if self.failsafe_s is not None:
            robot.deadman.limit_ms = round(self.failsafe_s * 1000)
        self.robot = robot
        self._obeyed = _ObeyedLines(robot)


class _ObeyedLines:
    """The lines that a text board's firmware has answered with OK since it booted."""

    def __init__(self, robot: Any) -> None:
        self.half = b""  # of the line that is being typed
        self.last = b""
        self.count = 0
        self._robot = robot
        self._drive = b""
        self._trips = 0  # of the failsafe, before that drive command

    def add(self, rest: bytes, answer: bytes) -> None:
        """Count the line that ``rest`` ends, if the answer is OK."""
        line, self.half = self.half + rest, b""
        at = answer.find(b"OK ")
        if at < 0:
            return
        self.count += 1
        self.last = b" ".join(line.split()[:_TOKENS])
        if answer[at + 3 : at + 4] == b"M":
            self._drive, self._trips = self.last, self._robot.deadman.trips

    def drive(self, board: Board) -> Pair:
        """The wheel speeds of the last drive command as the firmware parses them; 0 after its failsafe tripped."""
        if not self._drive or self._robot.deadman.trips != self._trips:
            return 0.0, 0.0
        read = board.firmware.module("common.lines")
        left, right = (read.clamp(read.number(token, 0, len(token)), -1.0) for token in self._drive.split()[1:3])
        return left, right
