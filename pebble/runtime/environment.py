"""The environment variables of the programs that a service starts."""

import os
from collections.abc import Iterable, Mapping

from pebble.runtime.parent import ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED

_LAUNCHERS = (ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED)  # between the launcher and this process


def withhold(passwords: Iterable[str]) -> None:
    """Empty these variables of this process: what it starts from now on does not receive the passwords in them.

    They remain set, so that a program can still read a config that names them.
    """
    for name in passwords:
        if name in os.environ:
            os.environ[name] = ""


def child_environment(*more: Mapping[str, str]) -> dict[str, str]:
    """This process's variables but the launcher's, and ``more`` of them; later ones replace earlier ones."""
    merged = {name: value for name, value in os.environ.items() if name not in _LAUNCHERS}
    for variables in more:
        merged |= variables
    return merged
