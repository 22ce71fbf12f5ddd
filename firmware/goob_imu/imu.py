"""Acceleration, angular rate and attitude from an MPU-6050's raw data, and recovery from its failures. Pure.

x ahead, y to the left, z up. Roll is about x, pitch about y, both 0 when it lies flat.
"""

import struct
from math import atan2, sqrt

from micropython import const

from common.ticks import add, diff

_RETRY_MS = const(1000)
_FAILURES = const(5)  # in a row
_INACCURATE = const(10)  # samples after power on that are not accurate yet
_CALIBRATION = const(200)  # samples
_STILL = const(500)  # 0.01 degrees/s around the first sample: more is motion
_ZERO = const(2500)  # 0.01 degrees/s: the data sheet allows a bias of +-20 degrees/s
_GRAVITY = 0.02  # weight of gravity in a sample's attitude: 0.5 s at 100 Hz
_GAP_MS = const(500)  # after a longer one the angular rate cannot be integrated

# the protocol has 0.001 m/s2 and 0.01 degrees/s in 16 bits: +-3.3 g and +-327 degrees/s, so the next larger ranges of
# the sensor are used and values are limited. Factors are over 2**14, so that products are small integers.
_MM_S2 = const(19613)  # 9806.65 / 8192 LSB per g
_CENTI_DPS = const(25013)  # 100 / 65.5 LSB per degree/s
_HALF = const(8192)
_CENTI_DEG = 5729.578  # per radian
_TURN = const(36_000)
_UPRIGHT = const(9000)


class Imu:
    """The sensor's values. Call ``read`` at every sample's time. ``log(text)`` reports failures and recovery.

    ``device``: see mpu6050.py. ``values``: ax ay az in mm/s2, gx gy gz in 0.01 degrees/s without ``bias``, 0.01 degrees
    C, roll and pitch in 0.01 degrees. ``calibrated``: how many of the 200 samples for the bias were taken.
    """

    def __init__(self, device, log) -> None:
        self.values = [0] * 9
        self.bias = [0] * 3
        self.good = self.failed = self.calibrated = 0  # good, failed: readings of the sensor
        self._device, self._log = device, log
        self._data = bytearray(14)
        self._skip = 0  # samples after power on that were skipped
        self._first = self._sums = self.bias  # `_learn` makes both lists; an existing one saves 100 bytes until then
        self._working = False  # it was started, and has not failed _FAILURES times in a row since
        self._in_a_row = 0  # failures
        self._retry_at: int | None = None
        self._read_at: int | None = None
        self._roll = self._pitch = 0.0

    def read(self, now: int) -> bool:
        """Read a sample; return True if there are new values."""
        try:
            if not self._working:
                if self._retry_at is None or diff(now, self._retry_at) >= 0:
                    self._start(now)
                return False
            self._device.read(self._data)
            if not any(self._data):
                raise OSError  # the sensor sleeps, as after a drop of its supply voltage
        except OSError:
            self._fail(now)
            return False
        self._in_a_row = 0
        self.good += 1
        self._scale()
        self._tilt(_GAP_MS if self._read_at is None else diff(now, self._read_at))
        self._read_at = now
        return True

    def _start(self, now: int) -> None:
        self._retry_at = add(now, _RETRY_MS)
        if not self._device.start():
            raise OSError
        self._log(b"imu_reinit" if self.good else b"imu_ready")
        self._working = True

    def _fail(self, now: int) -> None:
        if not self._working:
            self._log(b"imu_init_failed")  # `_start` has set the time of the next try
            return
        self.failed += 1
        self._in_a_row += 1
        if self._in_a_row == 1:
            self._log(b"imu_read_failed")
        elif self._in_a_row == _FAILURES:
            self._in_a_row = 0
            self._working = False
            self._retry_at = add(now, _RETRY_MS)

    def _scale(self) -> None:
        """Convert the raw data to ``values``, by factors over 2**14, rounded and limited to 16 bits."""
        raw = struct.unpack(">7h", self._data)
        values = self.values
        calibrating = self.calibrated < _CALIBRATION
        for axis in range(3):
            values[axis] = max(-32768, min(32767, raw[axis] * _MM_S2 + _HALF >> 14))
            turning = raw[axis + 4] * _CENTI_DPS + _HALF >> 14
            values[axis + 3] = max(-32768, min(32767, turning - self.bias[axis]))
        values[6] = raw[3] * 5 // 17 + 3653  # page 30: raw / 340 + 36.53 degrees C
        if calibrating:
            self._learn()

    def _learn(self) -> None:
        """Use the mean of 200 samples at rest as the bias. Motion restarts the count."""
        if self._skip < _INACCURATE:
            self._skip += 1
            return
        values = self.values
        if not self.calibrated:
            self._first = values[3:6]
            self._sums = [0] * 3
        for axis in range(3):
            turning = values[axis + 3]
            if abs(turning) > _ZERO or abs(turning - self._first[axis]) > _STILL:
                self.calibrated = 0
                return
            self._sums[axis] += turning
        self.calibrated += 1
        if self.calibrated == _CALIBRATION:
            for axis in range(3):
                self.bias[axis] = (self._sums[axis] + _CALIBRATION // 2) // _CALIBRATION

    def _tilt(self, ms: int) -> None:
        """Update roll and pitch from angular rate and gravity; ``ms`` is the time since the last sample."""
        values = self.values
        ax, ay, az = values[0], values[1], values[2]
        across = sqrt(ay * ay + az * az)
        if not ax and not across:
            return  # free fall: no direction of gravity
        roll, pitch = atan2(ay, az) * _CENTI_DEG, atan2(-ax, across) * _CENTI_DEG
        if ms < _GAP_MS:  # a complementary filter: the last attitude and its turn, corrected a little by gravity
            turned = self._roll + values[3] * ms / 1000
            roll = turned + _around(roll - turned) * _GRAVITY
            turned = self._pitch + values[4] * ms / 1000
            pitch = max(-_UPRIGHT, min(_UPRIGHT, turned + (pitch - turned) * _GRAVITY))
        self._roll, self._pitch = _around(roll), pitch
        values[7], values[8] = int(self._roll), int(pitch)


def _around(value: float) -> float:
    """Return the same angle within half a turn of 0."""
    return value - _TURN if value > _TURN // 2 else value + _TURN if value < -_TURN // 2 else value
