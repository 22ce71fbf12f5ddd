"""Lines of `pebble check` about a robot in a container: what cannot work there."""

import os
from collections.abc import Iterator

from pebble.config import Config
from pebble.extension import Facts
from pebble.motors.state_file import CONTAINER, StateFile


def facts(config: Config) -> Facts:
    """Return these lines in a container, and none elsewhere."""
    return Facts(table=tuple(("container", line) for line in _lines(config) if CONTAINER in os.environ))


def _lines(config: Config) -> Iterator[str]:
    if StateFile(config.state_file("estop")).lost:
        yield f"NOT SAVED: no volume holds {config.state_dir()}, so a stop ends with this container"
    yield "cannot work: reboot, restart and git pull by operators; pebble setup; releases in slots; systemd's watch"
    if config.serial_instances():
        yield "a serial device that returns under another node is lost: map it by its name in /dev/serial/by-id"
    if config.transport.kind == "zenoh":
        yield "pictures in shared memory stay in this container: others need its ipc and its volume of /run"
    yield "only if it is mapped: camera, sound, GPIO, a board to flash; Bluetooth pads belong to the host"
