"""``python -m pebble.services.serial_mcu_bridge CONFIG [INSTANCE]``: runs the bridge that the protocol selects.

``pebble/contract/serial_protocols.py`` lists the protocols and their bridges.
"""

import sys

from pebble.runtime.process import run
from pebble.services.serial_mcu_bridge.serial_service import SerialService, bridge_of

sys.exit(run(SerialService, choose=bridge_of))
