"""Whole robots and the page's server for tests with a browser: the truth is in the traces of the robots' motors.

``with Stage() as stage`` has the demo's four robots (4 s), ``with Stage("minilamp")`` only one (1.5 s).
"""

from __future__ import annotations

from pebble.rig.stage import Stage

__all__ = ["Stage"]
