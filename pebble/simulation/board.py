"""The motor MCUs of Goob and Fred without hardware: bytes in, bytes out, a clock passed in.

Behaves as their firmware does on the line: forgiving about input, an answer to every command, sensor reports at a
fixed rate, and motors that stop by themselves when nobody commands them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pebble.errors import ConfigError
from pebble.services.serial_mcu_bridge.splitter import LineSplitter
from pebble.simulation.motion import Pose, RobotMotion
from pebble.simulation.sensors import Battery, hall

FAILSAFE_S = 1.0  # the original's firmware waits 5 s

_TOKENS = 6  # the rest of a line is not looked at
_NUMBER = re.compile(rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)")
_LEFT_TRIM, _REVERSE_TRIM = 0.93, 0.7  # Fred's
_REVERSE_BLOCK_S = 0.34  # Fred's: its gears do not like a reversal at speed
_SHORTEST_FLASH_S = 0.05


@dataclass(frozen=True, slots=True)
class Kind:
    """What tells one board from another on the line."""

    baud: int
    sensor_names: tuple[str, str, str]
    sensor_period_s: float
    battery_period_s: float | None  # None: no voltage reports, the charger is told with the sensors
    right_motor_sign: int  # −1: mounted the other way round, so its output is inverted
    spares_gears: bool  # trims and blocks the reverse


KINDS: Final = {
    "goob": Kind(460800, ("a0", "a1", "a2"), 0.02, 5.0, -1, False),
    "fred": Kind(115200, ("t0", "t1", "t2"), 0.5, None, 1, True),
}


@dataclass(frozen=True, slots=True)
class Light:
    """What the LED does; parts 0..1. It glows steadily, or fades in and out once per ``period_s``."""

    blue: float
    green: float
    red: float
    period_s: float | None = None


@dataclass(frozen=True, slots=True)
class BoardState:
    """A look at the robot: wheel speeds in mm/s, ``drive`` −1..1 as commanded, ``motors`` as the pins show."""

    kind: str
    pose: Pose
    left_mm_s: float
    right_mm_s: float
    drive: tuple[float, float]
    motors: tuple[float, float]
    light: Light
    volts: float
    charging: bool
    commands: int
    last_command: str


class SimulatedMcu:
    """One board. ``receive`` what the host sends, ``tick`` often, and send what both return to the host.

    ``now`` is any monotonic clock in seconds; it only has to be the same in all calls.
    """

    def __init__(self, kind: str, now: float, *, failsafe_s: float = FAILSAFE_S, charging: bool = False) -> None:
        if kind not in KINDS:
            raise ConfigError(f"there is no simulated MCU {kind!r}, only {' and '.join(KINDS)}")
        self.kind, self.failsafe_s = kind, failsafe_s
        self.motion = RobotMotion()
        self.battery = Battery(charging=charging)
        self._board = KINDS[kind]
        self._commands: dict[int, tuple[int, Callable[[list[float], float], None]]] = {
            ord("M"): (2, self._drive),
            ord("L"): (3, self._glow),
            ord("F"): (4, self._flash),
        }
        self.boot(now)

    def boot(self, now: float) -> None:
        """Power on: the pose and the battery are the world's, everything else starts anew."""
        self._splitter = LineSplitter()
        self._now = self._driven_at = now
        self._forward_at = float("-inf")
        self._wheels = self._commanded = (0.0, 0.0)
        self._light = Light(0.0, 0.0, 1.0, 2.0)
        self._count, self._last = 0, ""
        self._sensors_due = now + self._board.sensor_period_s
        self._battery_due = now + (self._board.battery_period_s or math.inf)
        self._waiting = [b"Starting setup...", b"Done!"]
        if self._board.battery_period_s is not None:
            self._waiting.append(self._battery_line())

    def receive(self, data: bytes, now: float) -> bytes:
        """Obey ``data``, which may end in the middle of a line. Returns the answers."""
        self._advance(now)
        skipped = self._splitter.discarded_lines
        answers = [answer for line in self._splitter.feed(data) if (answer := self._obey(line.split(), now))]
        answers += [b"WARN line too long"] * (self._splitter.discarded_lines - skipped)
        return _lines(answers)

    def tick(self, now: float) -> bytes:
        """Let time pass until ``now``. Returns the reports that are due."""
        self._advance(now)
        reports, self._waiting = self._waiting, []
        if now >= self._sensors_due:
            self._sensors_due = _next(self._sensors_due, self._board.sensor_period_s, now)
            reports.append(self._sensor_line())
        if self._board.battery_period_s is not None and now >= self._battery_due:
            self._battery_due = _next(self._battery_due, self._board.battery_period_s, now)
            reports.append(self._battery_line())
        return _lines(reports)

    def state(self) -> BoardState:
        left, right = self._wheels
        return BoardState(
            kind=self.kind,
            pose=self.motion.pose,
            left_mm_s=self.motion.left_mm_s,
            right_mm_s=self.motion.right_mm_s,
            drive=self._commanded,
            motors=(left, right * self._board.right_motor_sign),
            light=self._light,
            volts=self.battery.volts,
            charging=self.battery.charging,
            commands=self._count,
            last_command=self._last,
        )

    def _advance(self, now: float) -> None:
        """Move on to ``now``; the failsafe stops the motors at its own time, however late this is called."""
        failsafe_at = self._driven_at + self.failsafe_s
        if self._wheels != (0.0, 0.0) and now >= failsafe_at:
            self._roll_until(failsafe_at)
            self._wheels = self._commanded = (0.0, 0.0)
        self._roll_until(now)

    def _roll_until(self, moment: float) -> None:
        seconds = max(0.0, moment - self._now)
        self._now = max(self._now, moment)
        self.motion.advance(*self._wheels, seconds)
        self.battery.advance(self.motion, seconds)

    # -- commands

    def _obey(self, tokens: list[bytes], now: float) -> bytes:
        """The first letter decides; missing numbers are an error, spare ones are ignored."""
        if not tokens:
            return b""
        letter = tokens[0][:1].upper()
        if letter[0] not in self._commands:
            return b"ERR unknown command"
        wanted, action = self._commands[letter[0]]
        numbers = [_number(token) for token in tokens[1:_TOKENS]]
        if len(numbers) < wanted:
            return b"ERR %s needs %d values" % (letter, wanted)
        action(numbers, now)
        self._count += 1
        self._last = b" ".join(tokens[:_TOKENS]).decode("ascii", "replace")
        return b"OK " + letter

    def _drive(self, numbers: list[float], now: float) -> None:
        self._driven_at = now
        self._commanded = _clamp(numbers[0], -1.0), _clamp(numbers[1], -1.0)
        self._wheels = self._spare_the_gears(*self._commanded, now) if self._board.spares_gears else self._commanded

    def _spare_the_gears(self, left: float, right: float, now: float) -> tuple[float, float]:
        """Fred: no way back right after a way ahead (turning stays), a slow reverse, a trimmed left wheel."""
        linear, turn = (left + right) / 2, (left - right) / 2
        if linear > abs(turn):
            self._forward_at = now
        elif linear < 0.0:
            linear *= 0.0 if now - self._forward_at < _REVERSE_BLOCK_S else _REVERSE_TRIM
        return _clamp((linear + turn) * _LEFT_TRIM, -1.0), _clamp(linear - turn, -1.0)

    def _glow(self, numbers: list[float], _now: float) -> None:
        self._light = Light(*(_clamp(part, 0.0) for part in numbers[:3]))

    def _flash(self, numbers: list[float], _now: float) -> None:
        blue, green, red = (_clamp(part, 0.0) for part in numbers[:3])
        self._light = Light(blue, green, red, max(_SHORTEST_FLASH_S, numbers[3]))

    # -- reports

    def _sensor_line(self) -> bytes:
        values = zip(self._board.sensor_names, hall(self.motion), strict=True)
        line = "T " + " ".join(f"{name}={value}" for name, value in values)
        if self._board.battery_period_s is None:
            line += f" chg={int(self.battery.charging)}"
        return line.encode()

    def _battery_line(self) -> bytes:
        return b"C chg=-1 v=%.3f" % self.battery.volts


def _number(token: bytes) -> float:
    """As the firmware reads it: the digits in front count, anything else (nan and inf too) is 0."""
    match = _NUMBER.match(token)
    value = float(match[0]) if match else 0.0
    return value if math.isfinite(value) else 0.0


def _clamp(value: float, lowest: float) -> float:
    return max(lowest, min(1.0, value))


def _next(due: float, period: float, now: float) -> float:
    """The next time after ``now`` on the grid of ``period``: what a pause missed is not made up for."""
    return due + period * (math.floor((now - due) / period) + 1)


def _lines(texts: list[bytes]) -> bytes:
    return b"".join(text + b"\r\n" for text in texts)
