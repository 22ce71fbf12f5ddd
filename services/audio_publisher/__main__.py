"""``python -m pebble.services.audio_publisher CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.audio_publisher.service import AudioPublisher

sys.exit(run(AudioPublisher))
