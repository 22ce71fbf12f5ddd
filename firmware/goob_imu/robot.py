"""Goob's second board: describes its MPU-6050 to the host and sends its samples, by pebble_serial_v1."""

import struct
from math import sqrt

from micropython import const

from common.described import Described
from common.ticks import Grid
from goob_imu import pins
from goob_imu.imu import Imu
from goob_imu.manifest import MANIFEST
from goob_imu.mpu6050 import Mpu6050

_SAMPLE_MS = const(10)
_STATE_EVERY = const(20)  # samples: 5 Hz
_RING = const(512)  # bytes for the host; a DESCRIBE has 506
_G_MM_S2 = 9806.65

_IMU_FAST = const(1)  # interfaces, as in the manifest
_IMU = const(2)
_HELLO_SIZE = const(49)  # the manifest's beginning

_SAMPLE = const(0x10)
_STATE = const(0x11)


class Robot(Described):
    """The board, which has no motors. Call ``step`` at least every 10 ms."""

    def __init__(self) -> None:
        super().__init__(MANIFEST, _HELLO_SIZE, _RING)
        self.imu = Imu(Mpu6050(pins), self.notify)
        self._grid = Grid(_SAMPLE_MS, self.now)
        self._until_state = _STATE_EVERY
        self._payload = bytearray(18)
        self._samples = self._states = 0  # sequence numbers: a gap shows lost frames

    def step(self) -> None:
        self.receive()
        if self._grid.due(self.now):
            self._sample()
        self.port.send()

    def stop(self) -> None:
        """Do nothing: the board has no motors."""

    def _sample(self) -> None:
        imu = self.imu
        if imu.read(self.now):
            struct.pack_into("<9h", self._payload, 0, *imu.values)
            self._samples += 1
            self.send(_SAMPLE, _IMU_FAST, self._samples, self._payload)
        self._until_state -= 1
        if self._until_state:
            return
        self._until_state = _STATE_EVERY
        ax, ay, az = imu.values[:3]
        norm = int(sqrt(ax * ax + ay * ay + az * az) / _G_MM_S2 * 1000)
        struct.pack_into("<HhhhIIH", self._payload, 0, norm, *imu.bias, imu.good, imu.failed, imu.calibrated)
        self._states += 1
        self.send(_STATE, _IMU, self._states, self._payload)


def build(_settings: dict) -> Robot:
    return Robot()
