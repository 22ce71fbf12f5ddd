"""Makes the payloads of ``sensors/imu*`` from an inertial sensor's values, and notices missing samples. Pure."""

from collections.abc import Collection, Mapping
from typing import Any, Final

from msgspec.structs import asdict

from pebble.config import SerialBridge
from pebble.contract.payloads import Imu, ImuFast, ImuFastValues, ImuHealth, ImuValues, Orientation, Vector
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS

#: Profiles of interfaces: every sample, and the summary for operators.
MOTION: Final = "imu.motion.v1"
SUMMARY: Final = "imu.summary.v1"
FAMILY: Final = "imu."

TIMEOUT_S = 5.0  # without a sample
FIRST_S = 2.0  # more for the first sample: the board boots, and is asked for its manifest

_ACCELERATION, _ROTATION = ("ax", "ay", "az"), ("gx", "gy", "gz")
_BIAS = ("gyro_bias_x_dps", "gyro_bias_y_dps", "gyro_bias_z_dps")
_FIELDS = {
    MOTION: frozenset((*_ACCELERATION, *_ROTATION, "temp_c", "roll_deg", "pitch_deg")),
    SUMMARY: frozenset(("accel_norm_g", *_BIAS, "samples_ok", "samples_error", "calibration_samples")),
}

Values = Mapping[str, Any]


def measured(values: Values) -> dict[str, tuple[Any, ...]]:
    """Return a sample's values by sensor. Because of noise, successive samples always differ."""
    axes = {"acceleration": _ACCELERATION, "rotation": _ROTATION}
    return {name: tuple(values[axis] for axis in names) for name, names in axes.items()}


def fits(profile: str, names: Collection[str]) -> bool:
    """True if these field names include all fields of the profile."""
    return _FIELDS[profile] <= set(names)


class ImuReports:
    """A maker of the payloads of one sensor; a summary repeats the newest sample."""

    def __init__(self, options: SerialBridge, instance: str) -> None:
        self._device, self._protocol, self._instance = str(options.serial.port), options.protocol, instance
        self._newest: ImuFastValues | None = None

    def motion(self, t: int, seq: int, mcu_ms: int, values: Values) -> ImuFast:
        """Return a sample as a payload. ``values``: the fields of MOTION, in m/s², degrees per second, °C, degrees."""
        self._newest = ImuFastValues(
            accel_mps2=_vector(values, *_ACCELERATION),
            gyro_dps=_vector(values, *_ROTATION),
            temp_c=round(values["temp_c"], 3),
            orientation_deg=Orientation(roll=round(values["roll_deg"], 3), pitch=round(values["pitch_deg"], 3)),
        )
        return ImuFast(t=t, seq=seq, mcu_ms=mcu_ms, value=self._newest)

    def summary(self, t: int, seq: int, mcu_ms: int, values: Values) -> Imu | None:
        """Return the summary; None before the first sample."""
        if self._newest is None:
            return None
        value = ImuValues(
            **asdict(self._newest),
            accel_norm_g=round(values["accel_norm_g"], 4),
            gyro_bias_dps=_vector(values, *_BIAS),
            health=ImuHealth(
                device=self._device,
                protocol=self._protocol,
                instance=self._instance,
                samples_ok=values["samples_ok"],
                samples_error=values["samples_error"],
                calibration_samples=values["calibration_samples"],
            ),
        )
        return Imu(t=t, seq=seq, mcu_ms=mcu_ms, value=value)


class ImuWatchdog:
    """A watchdog for missing samples while a device is connected. When it expires, the process must end.

    The clock is passed in.
    """

    def __init__(self, options: SerialBridge, instance: str) -> None:
        self._is_imu = SERIAL_PROTOCOLS[options.protocol].has_imu(instance)
        self._since: float | None = None  # the newest sample, or the opening of the line

    @property
    def timeout_s(self) -> float:
        """Seconds without a sample after which the watchdog expires; 0: never."""
        return TIMEOUT_S if self._is_imu else 0.0

    def found_imu(self) -> None:
        """Note that the device is an inertial sensor."""
        self._is_imu = True

    def begin(self, now: float) -> None:
        self._since = now + FIRST_S

    def end(self) -> None:
        """Stop watching, because there is no device."""
        self._since = None

    def sample(self, now: float) -> None:
        if self._since is not None:
            self._since = now

    def expired(self, now: float) -> bool:
        return self.timeout_s > 0 and self._since is not None and now - self._since > self.timeout_s


def _vector(values: Values, *names: str) -> Vector:
    x, y, z = (round(values[name], 4) for name in names)
    return Vector(x=x, y=y, z=z)
