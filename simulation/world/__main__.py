"""``python -m pebble.simulation.world FILE``."""

import sys

from pebble.simulation.world.program import main

sys.exit(main())
