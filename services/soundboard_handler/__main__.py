"""``python -m pebble.services.soundboard_handler CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.soundboard_handler.service import SoundboardHandler

sys.exit(run(SoundboardHandler))
