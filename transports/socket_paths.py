"""The limit on the length of a path of a unix socket."""

import os
from pathlib import Path

from pebble.errors import TransportError

#: The longest name of a socket in a run directory, of the frames of a microphone; those of peers are shorter.
LONGEST_SOCKET = "frames-microphone.sock"

_LIMIT = 108  # bytes, sizeof(sun_path): a longer path cannot be bound


def fits_socket(path: Path) -> bool:
    """True if a unix socket can have this path."""
    return len(os.fsencode(path)) < _LIMIT


def check_socket_path(path: Path) -> None:
    """Raise TransportError if ``path`` is too long for a unix socket."""
    if not fits_socket(path):
        raise TransportError(
            f"{path} is too long for a unix socket (limit {_LIMIT - 1} bytes): set transport.run_dir to a shorter path"
        )
