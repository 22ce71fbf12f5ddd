"""Self-describing MCUs as parts of a robot: their channels, aliases and peers, and the service that runs them."""

from pebble.contract.serial_protocols import SerialProtocol
from pebble.extension import Extension

EXTENSION = Extension(
    name="devices",
    needs=("imu", "pebble_serial_v1"),
    protocols={
        "pebble_serial_v1": SerialProtocol(
            "pebble.services.serial_mcu_bridge.devices.described_bridge:DescribedBridge", describes_itself=True
        )
    },
    private="pebble.services.serial_mcu_bridge.devices.private_topics:LocalOnly",
    page="docs/ext/boards.md",
)
