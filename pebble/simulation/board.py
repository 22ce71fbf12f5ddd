"""The serial MCUs of Goob and Fred without hardware: bytes in, bytes out, a clock passed in.

They run the firmware of the real boards (``firmware/``) on simulated pins, and move a body by what it puts out there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.simulation.bodies import Pair, body_of
from pebble.simulation.micropython.board import UID, Board
from pebble.simulation.micropython.clock import VirtualClock
from pebble.simulation.micropython.runner import Runner
from pebble.simulation.state import BoardState, Light

__all__ = ["KINDS", "BoardState", "Kind", "Light", "SimulatedMcu"]

_REPLAYED_S = 0.5  # a pause up to this is made up for turn by turn; after a longer one only what is due now is said
_TOKENS = 6  # of a line; the rest is not looked at
_LONGEST_LINE = 300  # bytes; more than the firmware takes
_DEADLINES_S = 2.0  # but whatever the firmware does by itself in silence is done after this


@dataclass(frozen=True, slots=True)
class Kind:
    """How to look after a board: ``turn_s`` is how fine its firmware's loop turns, ``tick_s`` how often to tick."""

    turn_s: float
    tick_s: float
    is_text: bool = True  # it speaks goob_base_v1


KINDS: Final = {
    "goob": Kind(0.005, 0.02),
    "fred": Kind(0.005, 0.02),
    "goob_imu": Kind(0.0025, 0.005, is_text=False),
}


class SimulatedMcu:
    """One board. ``receive`` what the host sends, ``tick`` often, and send what both return to the host.

    ``now`` is any monotonic clock in seconds; it only has to be the same in all calls. ``failsafe_s`` replaces the
    firmware's own limit; ``uid`` is what the MCU's maker wrote into it. ``on_motors(now, (left, right))`` hears each
    change of the motors, + = forward.
    """

    def __init__(
        self,
        kind: str,
        now: float,
        *,
        failsafe_s: float | None = None,
        charging: bool = False,
        uid: bytes = UID,
        on_motors: Callable[[float, Pair], None] | None = None,
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"there is no simulated MCU {kind!r}, only {' and '.join(KINDS)}")
        if failsafe_s is not None and not KINDS[kind].is_text:
            raise ConfigError(f"{kind} has no motors and no failsafe")
        self.kind, self.failsafe_s = kind, failsafe_s
        self.profile = KINDS[kind]
        self._clock = VirtualClock(now)
        self.board = Board(self._clock, uid=uid)
        self.body = body_of(kind, self.board)
        self.body.on_motors = on_motors or self.body.on_motors
        self.motion, self.battery = self.body.motion, self.body.battery
        self.battery.charging = charging
        self._first_words = self._line = self._last = self._driven = b""
        self._commands = self._trips = 0
        self._runner = Runner(self.board, kind, on_boot=self._booted)
        self._start()

    @property
    def resets(self) -> int:
        """How often the board started anew by itself."""
        return self.board.resets

    def boot(self, now: float) -> None:
        """Press the button: the pose and the battery are the world's, everything else starts anew."""
        self._clock.until(now)
        self._runner.boot()
        self._start()

    def disturb(self, on: bool) -> None:
        """Make every device on its I2C bus fail, or work again."""
        self.board.bus.disturbed = on

    def receive(self, data: bytes, now: float) -> bytes:
        """Obey ``data``, which may end in the middle of a line. Returns what the board answers and says."""
        said = self._advance(now, self.profile.tick_s)
        if not self.profile.is_text:
            return said + self._take(data, now)
        *lines, rest = data.split(b"\n")
        for line in lines:
            answer = self._take(line + b"\n", now)
            self._note(self._line + line, answer)
            self._line = b""
            said += answer
        if rest:
            self._line = (self._line + rest)[:_LONGEST_LINE]
            said += self._take(rest, now)
        return said

    def tick(self, now: float) -> bytes:
        """Let time pass until ``now``. Returns what the board said meanwhile."""
        first, self._first_words = self._first_words, b""
        return first + self._advance(now, self.profile.turn_s) + self._turn(now)

    def state(self) -> BoardState:
        return self.body.state(self._drive(), self._commands, self._last.decode("ascii", "replace"))

    # -- time

    def _advance(self, now: float, turn_s: float) -> bytes:
        """Turn the loop up to just before ``now``, at least every ``turn_s``. Returns what the board said."""
        said = b""
        behind = now - self._clock.now()
        if behind <= turn_s:
            return said
        replayed = behind <= _REPLAYED_S
        until = now if replayed else self._clock.now() + _DEADLINES_S
        while (moment := self._clock.now() + turn_s) < min(now, until):
            turned = self._turn(moment)
            said += turned if replayed else b""
        return said

    def _turn(self, now: float) -> bytes:
        """One turn of the firmware's loop at ``now``, unless something still holds it up."""
        if self._clock.now() > now:
            return b""
        self._clock.until(now)
        self._runner.step()
        self.body.settle()
        return self.board.said()

    def _take(self, data: bytes, now: float) -> bytes:
        self.board.type(data)
        said = self._turn(now)
        while (unread := self.board.unread) and self._clock.now() <= now:
            said += self._turn(now)
            if self.board.unread == unread:  # it does not want any now
                break
        return said

    def _start(self) -> None:
        """The first turn belongs to the boot; what is said in it is nobody's answer."""
        self._runner.step()
        self._first_words = self.board.said()

    # -- what it was told

    def _booted(self, robot: Any) -> None:
        if self.failsafe_s is not None:
            robot.deadman.limit_ms = round(self.failsafe_s * 1000)
        self._robot = robot
        self._line = self._last = self._driven = b""
        self._commands = self._trips = 0

    def _note(self, line: bytes, answer: bytes) -> None:
        """Count ``line`` if the firmware said OK to it."""
        at = answer.find(b"OK ")
        if at < 0:
            return
        self._commands += 1
        self._last = b" ".join(line.split()[:_TOKENS])
        if answer[at + 3 : at + 4] == b"M":
            self._driven, self._trips = self._last, self._robot.deadman.trips

    def _drive(self) -> Pair | None:
        """The wheel speeds of the last drive command, as the firmware reads them; 0 once its failsafe has struck."""
        if not self.profile.is_text:
            return None
        if not self._driven or self._robot.deadman.trips != self._trips:
            return 0.0, 0.0
        read = self.board.firmware.module("common.lines")
        left, right = (read.clamp(read.number(token, 0, len(token)), -1.0) for token in self._driven.split()[1:3])
        return left, right
