"""``python -m pebble.services.autonomy_manager CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.autonomy_manager.service import AutonomyManager

sys.exit(run(AutonomyManager))
