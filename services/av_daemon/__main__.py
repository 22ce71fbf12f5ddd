"""``python -m pebble.services.av_daemon CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.av_daemon.service import AvDaemon

sys.exit(run(AvDaemon))
