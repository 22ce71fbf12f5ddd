"""``python -m pebble.services.gstreamer_mirror CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.gstreamer_mirror.service import GstreamerMirror

sys.exit(run(GstreamerMirror))
