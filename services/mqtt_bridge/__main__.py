"""``python -m pebble.services.mqtt_bridge CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.mqtt_bridge.service import MqttBridge

sys.exit(run(MqttBridge))
