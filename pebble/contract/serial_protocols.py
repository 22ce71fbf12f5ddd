"""The protocols of serial lines to MCUs, a row each.

An extension adds a protocol by declaring such a row, which names the service. The table is apart from the services
because every process reads the config, and should not import the library of serial ports for these names.
"""

from __future__ import annotations

from typing import Final

from msgspec import Struct

_IMU_INSTANCE = "imu"


class SerialProtocol(Struct, frozen=True):
    """A protocol. ``service``: the ``module:class`` that runs such a line, a subclass of SerialService."""

    service: str
    drives: bool = False  # has motors and lights: takes drive commands, is stopped when they end
    is_imu: bool = False  # every such device is an inertial sensor
    describes_itself: bool = False  # only its manifest says what the device is

    def has_imu(self, instance: str) -> bool:
        """True if the MCU on a line of this name has an inertial sensor, by the config alone."""
        return self.is_imu or (self.describes_itself and instance == _IMU_INSTANCE)


#: By the config's ``protocol``; extensions add theirs.
SERIAL_PROTOCOLS: Final[dict[str, SerialProtocol]] = {
    "goob_base_v1": SerialProtocol("pebble.services.serial_mcu_bridge.text.motor_bridge:MotorBridge", drives=True),
}
OF_CORE: Final = frozenset(SERIAL_PROTOCOLS)
