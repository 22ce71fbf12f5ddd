"""``python -m pebble.services.homeassistant CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.homeassistant.service import HomeAssistantService

sys.exit(run(HomeAssistantService))
