"""``python -m pebble.services.video_stream CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.video_stream.service import VideoStream

sys.exit(run(VideoStream))
