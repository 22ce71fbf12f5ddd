"""``python -m pebble.services.ros1_bridge CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.ros1_bridge.service import Ros1Reader, service_of

sys.exit(run(Ros1Reader, choose=service_of))
