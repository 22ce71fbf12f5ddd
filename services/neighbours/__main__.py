"""``python -m pebble.services.neighbours CONFIG``."""

import sys

from pebble.runtime.process import run
from pebble.services.neighbours.service import NeighboursService

sys.exit(run(NeighboursService))
