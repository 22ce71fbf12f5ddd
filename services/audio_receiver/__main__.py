"""``python -m pebble.services.audio_receiver CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.audio_receiver.service import AudioReceiver

sys.exit(run(AudioReceiver))
