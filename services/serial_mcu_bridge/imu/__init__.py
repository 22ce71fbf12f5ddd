"""Inertial sensors: the service of a sensor on a line of text, and the payloads of all kinds of sensors."""

from pebble.contract.serial_protocols import SerialProtocol
from pebble.extension import Extension

EXTENSION = Extension(
    name="imu",
    protocols={
        "imu_mpu6050_v1": SerialProtocol("pebble.services.serial_mcu_bridge.imu.bridge:ImuBridge", is_imu=True),
    },
    page="docs/ext/boards.md",
)
