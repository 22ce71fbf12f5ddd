"""``python -m pebble.services.recorder CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.recorder.service import RobotRecorder

sys.exit(run(RobotRecorder))
