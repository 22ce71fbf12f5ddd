"""Drive commands, by which a board that does not itself move the wheels finds out that its sensors have failed."""

from pebble.contract import DRIVE
from pebble.contract.payloads import Drive
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.transports import Subscription


def follow_driving(service: SerialService) -> Subscription:
    """Subscribe to drive commands: while they move the wheels, a sensor that never changes has failed."""

    def note(drive: Drive) -> None:
        timeout_s = service.options.safety.drive_timeout_seconds
        service.sensors.drive(service.clock() + timeout_s if drive.moves else 0.0)

    return service.listen(DRIVE, note)
