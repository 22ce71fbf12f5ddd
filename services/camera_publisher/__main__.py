"""``python -m pebble.services.camera_publisher CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.camera_publisher.service import CameraPublisher

sys.exit(run(CameraPublisher))
