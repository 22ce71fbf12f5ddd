"""``python -m pebble.services.serial_mcu_bridge CONFIG [INSTANCE]``."""

import sys

from pebble.process import run
from pebble.services.serial_mcu_bridge.bridges import bridge_of
from pebble.services.serial_mcu_bridge.serial_service import SerialService

sys.exit(run(SerialService, choose=bridge_of))
