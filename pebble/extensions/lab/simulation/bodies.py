"""The bodies of robots around simulated boards: motors, wheels, battery, sensors, lights and I2C devices."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.i2c_devices import MotorShield, Mpu6050
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.pins import PinName
from pebble.extensions.lab.simulation.motion import Battery, RobotMotion, hall

_SLICE_S = 0.02  # step of the integration of motion
_MOST_SLICES = 1_000
_ONE_TURN_S = 0.001  # changes of outputs within this time count as one

Pair = tuple[float, float]


class Body:
    """A robot's body, from the board's pins to the pose. Make it before loading the firmware, which needs its devices.

    ``end_turn`` must be called after every turn of the firmware's loop. It calls ``on_motors(now, (left, right))`` when
    the motors have changed: −1..1, + = forward of the robot, however the motors are mounted.
    """

    kind: str
    cells = 2

    def __init__(self, board: Board, motion: RobotMotion | None = None) -> None:
        self.board = board
        board.configure_for(self.kind)
        self.pins: Any = board.firmware.module(f"{self.kind}.pins")
        self.motion = motion or RobotMotion()
        self.battery = Battery(self.cells)
        self.on_motors: Callable[[float, Pair], None] = lambda _now, _motors: None
        self._advanced_at = board.clock.now()  # the time to which motion and battery are advanced
        self._changed_at = self._advanced_at  # when an output last changed
        self._motors = self.motors = (0.0, 0.0)  # as the outputs set them, and as on_motors was told last
        self._outputs_changed = False  # since they were last read
        board.pins.before_change = self.before_output_change
        self.connect()

    def connect(self) -> None:
        """Connect sensors and devices to the board."""

    def before_output_change(self) -> None:
        """Advance motion and battery to the present time before an output of the board changes.

        Several may change in one turn: changes within a millisecond are reported together.
        """
        now = self.board.clock.now()
        if self._outputs_changed and now == self._changed_at:
            return  # another output changes at the same moment
        if now - self._changed_at > _ONE_TURN_S:
            self.end_turn()  # reports the changes before this one
        self.advance()  # with the outputs as they were until now
        self._outputs_changed, self._changed_at = True, now

    def end_turn(self) -> None:
        """End a turn of the firmware: call ``on_motors`` if the motors have changed."""
        self._read_outputs()
        if self._motors != self.motors:
            self.motors = self._motors
            self.on_motors(self._changed_at, self.motors)

    def advance(self) -> None:
        """Advance motion and battery to the present time."""
        now = self.board.clock.now()
        seconds = now - self._advanced_at
        if seconds <= 0.0:
            return
        self._advanced_at = now
        self._read_outputs()
        at_rest = self._motors == (0.0, 0.0) == (self.motion.left_mm_s, self.motion.right_mm_s)
        slices = 1 if at_rest else min(_MOST_SLICES, math.ceil(seconds / _SLICE_S))
        for _ in range(slices):
            self.motion.advance(*self._motors, seconds / slices)
            self.battery.advance(self.motion, seconds / slices)

    def _read_outputs(self) -> None:
        """Set the motors by the board's outputs, if these have changed."""
        if self._outputs_changed:
            self._outputs_changed = False
            self._motors = self.forward(*self.outputs())

    def outputs(self) -> Pair:
        """Return what the pins command to the left and the right motor driver, −1..1; + is forward for the driver."""
        return 0.0, 0.0

    def forward(self, left: float, right: float) -> Pair:
        """Convert ``outputs`` to speeds of the robot's sides: + = forward."""
        return left, right

    def half_bridge(self, pins: tuple[PinName, PinName]) -> float:
        """Return the speed of a motor on half a DRV8833: the first pin high turns it forward."""
        forward, back = map(self.board.duty, pins)
        return round(forward - back, 4) + 0.0  # 16-bit duties; + 0.0: no −0.0

    def measure_battery(self) -> None:
        """Connect the battery to its pin, through the divider that the firmware assumes."""
        self.board.set_volts(self.pins.BATTERY, self._divided)

    def measure_wheels(self) -> None:
        """Connect the hall sensors to their pins, scaled to the range of the ADC."""
        for index, pin in enumerate(self.pins.SENSORS):
            self.board.set_volts(pin, partial(self._hall, index))

    def _divided(self) -> float:
        self.advance()
        return self.battery.volts / float(self.pins.BATTERY_FULL_V) * self.board.port.adc_v

    def _hall(self, index: int) -> float:
        self.advance()
        return hall(self.motion)[index] * self.board.port.adc_v


class TwoWheeled(Body):
    """Two wheels on a DRV8833."""

    def outputs(self) -> Pair:
        return self.half_bridge(self.pins.LEFT), self.half_bridge(self.pins.RIGHT)


class Goob(TwoWheeled):
    """Two wheels with hall sensors, headlights, and a measured battery."""

    kind = "goob"

    def connect(self) -> None:
        self.measure_wheels()
        self.measure_battery()

    def forward(self, left: float, right: float) -> Pair:
        return left, 0.0 - right  # the right motor is mounted in reverse

    def light(self) -> list[float]:
        """Return the brightness of blue, green and red, 0..1."""
        return [round(self.board.duty(self.pins.LED), 3)] * 3


class Fred(TwoWheeled):
    """Two wheels with hall sensors, an RGB light, and a pin that is high on the charger."""

    kind = "fred"

    def connect(self) -> None:
        self.measure_wheels()
        self.board.set_pin(self.pins.CHARGE, lambda: self.battery.charging)

    def light(self) -> list[float]:
        """Return the brightness of blue, green and red, 0..1."""
        return [round(self.board.duty(pin), 3) for pin in self.pins.LED]


class Minilamp(TwoWheeled):
    """Two wheels and a battery of one cell; the grousers' effect is not simulated."""

    kind = "minilamp"
    cells = 1

    def connect(self) -> None:
        self.measure_battery()


class Benjr(Body):
    """Two reversed motors on an I2C shield; one cell behind a battery shield."""

    kind = "benjr"
    cells = 1

    def connect(self) -> None:
        self.shield = MotorShield()
        self.shield.before_change = self.before_output_change
        self.board.bus.attach(self.pins.MOTOR_SHIELD, self.shield)
        self.measure_battery()

    def outputs(self) -> Pair:
        return self.shield.speeds

    def forward(self, left: float, right: float) -> Pair:
        return 0.0 - left, 0.0 - right


class GoobImu(Body):
    """The second board of a Goob: an MPU-6050 that lies flat and follows ``motion``."""

    kind = "goob_imu"

    def __init__(self, board: Board, motion: RobotMotion | None = None) -> None:
        super().__init__(board)
        self.imu = Mpu6050(board.clock.now, motion)
        board.bus.attach(self.pins.IMU, self.imu)


BODIES: Final[dict[str, type[Body]]] = {body.kind: body for body in (Goob, Fred, Minilamp, Benjr, GoobImu)}


def body_of(kind: str, board: Board, motion: RobotMotion | None = None) -> Body:
    """Return the body of a robot around ``board``, whose firmware is not yet loaded.

    ``motion``: the robot's place and ground; by default the origin of an empty floor. Raises ConfigError for an unknown
    kind.
    """
    if kind not in BODIES:
        raise ConfigError(f"unknown simulated robot {kind!r}; known: {', '.join(BODIES)}")
    return BODIES[kind](board, motion)
