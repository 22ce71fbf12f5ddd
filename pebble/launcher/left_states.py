"""Removes what programs that a robot no longer has have left at its MQTT broker, where their last states look live.

The hub of a Zenoh robot has no states of an earlier start; at the remote broker the bridge removes them.
"""

import json
import logging
import sys
import time
from collections.abc import Iterable
from contextlib import suppress

from pebble.config import Config, config_of_process
from pebble.errors import PebbleError
from pebble.runtime.whole_file import make_folder, write
from pebble.transports import Message, QoS, State

log = logging.getLogger(__name__)

_LIMIT_S = 10.0  # of the process


def remove_left_states(config: Config, names: Iterable[str]) -> None:
    """Remove all states at the broker if one of the programs of the last start is missing in ``names``.

    Call this before any program runs: those that start publish theirs anew. Another process does it, as the launcher
    opens no transport. If it fails the next start tries again.
    """
    file, now = config.state_file("programs"), sorted(names)
    try:
        before = [str(name) for name in json.loads(file.read_bytes())]
    except (OSError, ValueError, TypeError, RecursionError):  # the first start, or it is damaged
        before = []
    if gone := sorted({*before}.difference(now)):
        import subprocess  # few starts need it

        log.info("removing the states at the robot's broker: it no longer has %s", ", ".join(gone))
        command = [sys.executable, "-m", __name__, str(config.path)]
        try:
            subprocess.run(command, stdin=subprocess.DEVNULL, timeout=_LIMIT_S, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            log.warning("states of programs that it no longer has stay at its broker: %s", error)
            return
    if before != now:
        with suppress(PebbleError, OSError):
            make_folder(file.parent)
            write(file, json.dumps(now).encode(), 0o600, PebbleError)


def main(path: str) -> int:
    """Remove the retained states of the robot with this config; return the exit code."""
    from pebble.forwarding.retained_window import INITIAL_SYNC_S  # the launcher needs none of these
    from pebble.forwarding.subjects import Subjects
    from pebble.runtime.connections import local_transport
    from pebble.services.mqtt_bridge.leftovers import state_filters

    config, left = config_of_process(path), set[str]()

    def note(message: Message) -> None:
        if message.retain and message.payload:
            left.add(message.topic)

    with local_transport(config, "left-states") as transport:
        if transport.state is not State.CONNECTED:
            return 1
        filters = state_filters(config.base, Subjects(config))
        transport.subscribe_all(dict.fromkeys(filters, note), echo=False, direct=True)
        time.sleep(INITIAL_SYNC_S)
        for topic in sorted(left):
            transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
