"""Which service serves a serial line, by the protocol that its config names."""

from __future__ import annotations

from typing import Final

from pebble.config import Config
from pebble.services.serial_mcu_bridge.described_bridge import DescribedBridge
from pebble.services.serial_mcu_bridge.imu_bridge import ImuBridge
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.service import SerialMcuBridge

_BRIDGES: Final[dict[str, type[SerialService]]] = {
    "goob_base_v1": SerialMcuBridge,
    "imu_mpu6050_v1": ImuBridge,
    "pebble_serial_v1": DescribedBridge,
}


def bridge_of(config: Config) -> type[SerialService]:
    """For a line's own view of its robot's config."""
    return _BRIDGES[config.services.serial_mcu_bridge.protocol]
