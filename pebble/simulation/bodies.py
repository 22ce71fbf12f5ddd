"""What hangs on a simulated board: motors, wheels, a battery, sensors, lights and I2C devices, per robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.pins import PinName
from pebble.simulation.motion import RobotMotion
from pebble.simulation.motor_shield import MotorShield
from pebble.simulation.mpu6050 import Mpu6050
from pebble.simulation.sensors import Battery, hall
from pebble.simulation.state import DARK, BoardState, Light

_SLICE_S = 0.02  # how finely a way is integrated
_MOST_SLICES = 1_000
_ONE_TURN_S = 0.001  # outputs that change within this time change together

Pair = tuple[float, float]


class Body:
    """A robot around its board, from pins to pose. Made before the firmware is loaded, because it needs its devices.

    ``on_motors(now, (left, right))`` hears what the motors do from then on, −1..1, + = forward of the robot however
    they are mounted. It is called by ``settle``, which belongs at the end of every turn of the firmware's loop.
    """

    kind: str
    cells = 2

    def __init__(self, board: Board) -> None:
        self.board = board
        board.shape_for(self.kind)
        self.pins: Any = board.firmware.module(f"{self.kind}.pins")
        self.motion = RobotMotion()
        self.battery = Battery(self.cells)
        self.on_motors: Callable[[float, Pair], None] = lambda _now, _motors: None
        self._rolled = self._changed_at = board.clock.now()
        self._motors = self._told = (0.0, 0.0)
        self._stale = False
        board.pins.before_change = self.changing

    def changing(self) -> None:
        """An output of the board is about to change; more will follow in the same turn."""
        now = self.board.clock.now()
        if self._stale and now == self._changed_at:
            return
        if now - self._changed_at > _ONE_TURN_S:
            self.settle()
        self.roll()
        self._stale, self._changed_at = True, now

    def settle(self) -> None:
        """The firmware's turn is over: say it if the motors do something else than before."""
        self._look()
        if self._motors != self._told:
            self._told = self._motors
            self.on_motors(self._changed_at, self._motors)

    def roll(self) -> None:
        """Let the world go on until now: wheels turn, the battery empties."""
        now = self.board.clock.now()
        seconds, self._rolled = now - self._rolled, max(now, self._rolled)
        if seconds <= 0.0:
            return
        self._look()
        at_rest = self._motors == (0.0, 0.0) == (self.motion.left_mm_s, self.motion.right_mm_s)
        slices = 1 if at_rest else min(_MOST_SLICES, math.ceil(seconds / _SLICE_S))
        for _ in range(slices):
            self.motion.advance(*self._motors, seconds / slices)
            self.battery.advance(self.motion, seconds / slices)

    def _look(self) -> None:
        """At the outputs, if they have changed."""
        if self._stale:
            self._stale = False
            self._motors = self.forward(*self.outputs())

    def state(self, drive: Pair | None = None, commands: int = 0, last_command: str = "") -> BoardState:
        """A look at it now; without ``drive``, what the motors do counts as what they were told."""
        self.roll()
        self._look()
        return BoardState(
            kind=self.kind,
            pose=self.motion.pose,
            left_mm_s=self.motion.left_mm_s,
            right_mm_s=self.motion.right_mm_s,
            drive=self._motors if drive is None else drive,
            motors=self.outputs(),
            light=self.light(),
            volts=self.battery.volts,
            charging=self.battery.charging,
            commands=commands,
            last_command=last_command,
        )

    def outputs(self) -> Pair:
        """What the motor drivers get, left and right, −1..1: + is their own forward."""
        return 0.0, 0.0

    def forward(self, left: float, right: float) -> Pair:
        """``outputs`` seen from the robot: + = forward."""
        return left, right

    def light(self) -> Light:
        return DARK

    def bridge(self, pins: tuple[PinName, PinName]) -> float:
        """A motor between the two outputs of half a DRV8833: the first high turns it forward."""
        forward, back = pins
        level = self.board.duty
        return round(level(forward) - level(back), 4) + 0.0  # 16-bit duties; + 0.0: no −0.0

    def measure_battery(self) -> None:
        """Lead the battery's voltage to its pin, through the divider that the firmware reckons with."""
        self.board.set_volts(self.pins.BATTERY, self._divided)

    def measure_wheels(self) -> None:
        """Put the hall sensors on their pins; their signal fits the range of the ADC."""
        for index, pin in enumerate(self.pins.SENSORS):
            self.board.set_volts(pin, partial(self._hall, index))

    def _divided(self) -> float:
        self.roll()
        return self.battery.volts / float(self.pins.BATTERY_FULL_V) * self.board.port.adc_v

    def _hall(self, index: int) -> float:
        self.roll()
        return hall(self.motion)[index] * self.board.port.adc_v


class Driven(Body):
    """Two wheels on a DRV8833."""

    def outputs(self) -> Pair:
        return self.bridge(self.pins.LEFT), self.bridge(self.pins.RIGHT)


class Goob(Driven):
    """Headlights, hall sensors and a battery that is measured."""

    kind = "goob"

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self.measure_wheels()
        self.measure_battery()

    def forward(self, left: float, right: float) -> Pair:
        return left, 0.0 - right  # the right motor is mounted the other way round

    def light(self) -> Light:
        level = round(self.board.duty(self.pins.LED), 3)
        return Light(level, level, level)


class Fred(Driven):
    """An RGB light, hall sensors, and a pin that says whether it stands on its charger."""

    kind = "fred"

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self.measure_wheels()
        board.set_pin(self.pins.CHARGE, lambda: self.battery.charging)

    def light(self) -> Light:
        return Light(*(round(self.board.duty(pin), 3) for pin in self.pins.LED))


class Minilamp(Driven):
    """Two wheels and a pair of grousers, one cell."""

    kind = "minilamp"
    cells = 1

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self.measure_battery()

    @property
    def grousers(self) -> float:
        return self.bridge(self.pins.GROUSERS)


class Benjr(Body):
    """Both motors hang on an I2C shield, mounted backwards; one cell behind a battery shield."""

    kind = "benjr"
    cells = 1

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self.shield = MotorShield()
        self.shield.before_change = self.changing
        board.attach_i2c(self.pins.MOTOR_SHIELD, self.shield)
        self.measure_battery()

    def outputs(self) -> Pair:
        return self.shield.speeds

    def forward(self, left: float, right: float) -> Pair:
        return 0.0 - left, 0.0 - right


class GoobImu(Body):
    """The second board of a Goob: an MPU-6050 that lies flat; ``rides`` is the motion it goes along with."""

    kind = "goob_imu"

    def __init__(self, board: Board, rides: RobotMotion | None = None) -> None:
        super().__init__(board)
        self.imu = Mpu6050(board.clock.now, rides)
        board.attach_i2c(self.pins.IMU, self.imu)


BODIES: Final[dict[str, Callable[[Board], Body]]] = {kind.kind: kind for kind in (Goob, Fred, Minilamp, Benjr, GoobImu)}


def body_of(kind: str, board: Board) -> Body:
    """The body of a robot around ``board``, whose firmware is still to be loaded; ConfigError for an unknown kind."""
    if kind not in BODIES:
        raise ConfigError(f"there is no simulated robot {kind!r}, only {', '.join(BODIES)}")
    return BODIES[kind](board)
