"""What passes between a robot's own fabric and the broker that mirrors it: all of it, both ways, but media."""

from __future__ import annotations

from typing import Final

from pebble.contract import Kind
from pebble.forwarding.routing import Rules, Side

MIRROR: Final = Rules(passes={side: frozenset(Kind) for side in Side}, leaves_robot=False)
