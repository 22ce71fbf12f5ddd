"""Prints what a robot's own side retains of its state, as JSON: ``python -m pebble.checks.report.states CONFIG``."""

import json
import sys
import time
from pathlib import Path
from typing import Any

from pebble.client.connection import Target, connected
from pebble.contract import AUTONOMY_STATUS, CAPABILITIES, CONTROL_STATE, ESTOP_STATE, LINK, MEDIA_STATUS, STATUS, codec
from pebble.errors import PebbleError
from pebble.transports import Message

_STATES = (CAPABILITIES, CONTROL_STATE, ESTOP_STATE, LINK, MEDIA_STATUS, AUTONOMY_STATUS, STATUS)
_STATES_S = 1.0  # until all have come


def states(config: Path) -> dict[str, Any]:
    """By topic. Raises PebbleError if the robot is not reached."""
    found: dict[str, Any] = {}

    def take(message: Message) -> None:
        try:
            found[message.topic] = json.loads(message.payload) if not codec.too_deep(message.payload) else "too deep"
        except ValueError:
            found[message.topic] = f"{len(message.payload)} bytes"

    with connected(Target(config=config, program="report")) as (transport, names):
        for channel in _STATES:
            transport.subscribe(channel.filter(names.base), take)
        time.sleep(_STATES_S)
    return dict(sorted(found.items()))


if __name__ == "__main__":
    try:
        print(json.dumps(states(Path(sys.argv[1])), indent=1, ensure_ascii=False))  # noqa: T201
    except PebbleError as error:
        sys.exit(str(error))
