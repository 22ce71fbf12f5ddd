"""``python -m pebble`` is the ``pebble`` command."""

import sys

from pebble.cli import main

sys.exit(main())
