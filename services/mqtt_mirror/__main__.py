"""``python -m pebble.services.mqtt_mirror CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.mqtt_mirror.service import MqttMirror

sys.exit(run(MqttMirror))
