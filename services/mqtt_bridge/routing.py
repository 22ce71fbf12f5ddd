"""The paper's Table A.1: what passes between the robot and its operators."""

from __future__ import annotations

from typing import Final

from pebble.contract import Kind
from pebble.forwarding.routing import Rules, Side

#: Never: the robot's own outgoing topics back into it, media, what stays on the robot, other components' topics, and
#: kept copies of anything that happens once (pebble.forwarding.routing.route says those for every table).
TABLE_A1: Final = Rules(
    passes={
        Side.LOCAL: frozenset({Kind.STATE, Kind.EVENT, Kind.STREAM, Kind.FLAG, Kind.ACTION}),
        Side.REMOTE: frozenset({Kind.COMMAND, Kind.FLAG, Kind.ACTION, Kind.FEED}),
    },
    mirrored={Side.LOCAL: frozenset({Kind.COMMAND, Kind.FEED})},
    leaves_robot=True,
)
