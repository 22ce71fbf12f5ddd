"""The MPU-6050 on I2C. A driver.

Registers: InvenSense RM-MPU-6000A-00 revision 4.2, sections 4.2 to 4.5 (pages 11 to 15), 4.17 to 4.19 (29 to 31),
4.28 (40), 4.32 (45). All transfers may raise OSError; the device must then be started again.
"""

from machine import Pin, SoftI2C
from micropython import const

_SMPLRT_DIV = const(0x19)  # .. CONFIG, GYRO_CONFIG, ACCEL_CONFIG
_ACCEL_XOUT_H = const(0x3B)  # .. TEMP_OUT, GYRO_ZOUT_L
_PWR_MGMT_1 = const(0x6B)
_WHO_AM_I = const(0x75)


class Mpu6050:
    """The sensor: +-4 g, 8192 LSB/g; +-500 degrees/s, 65.5 LSB each; 100 Hz.

    ``pins`` has the pins SCL and SDA, and IMU, the address of the sensor on that bus.
    """

    def __init__(self, pins) -> None:
        self._i2c = SoftI2C(scl=Pin(pins.SCL), sda=Pin(pins.SDA), freq=400_000)
        self._address = pins.IMU

    def start(self) -> bool:
        """Configure the device; return False if another device answers at its address."""
        if self._i2c.readfrom_mem(self._address, _WHO_AM_I, 1) != b"\x68":
            return False
        # no sleep, clock from the X gyroscope as the manual recommends
        self._i2c.writeto_mem(self._address, _PWR_MGMT_1, b"\x01")
        # 1 kHz / (1 + 9); low-pass 3: 44 Hz accelerometer, 42 Hz gyroscope; FS_SEL 1; AFS_SEL 1
        self._i2c.writeto_mem(self._address, _SMPLRT_DIV, b"\x09\x03\x08\x08")
        return True

    def read(self, data: bytearray) -> None:
        """Read fourteen bytes, big-endian i16: acceleration x y z, temperature, gyroscope x y z."""
        self._i2c.readfrom_mem_into(self._address, _ACCEL_XOUT_H, data)
