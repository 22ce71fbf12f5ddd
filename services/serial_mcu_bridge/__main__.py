"""``python -m pebble.services.serial_mcu_bridge CONFIG [INSTANCE]``."""

import sys

from pebble.process import run
from pebble.services.serial_mcu_bridge.service import SerialMcuBridge

sys.exit(run(SerialMcuBridge))
