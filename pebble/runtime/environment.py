"""The environment variables of the programs that a service starts."""

import os
from collections.abc import Iterable, Mapping

from pebble.runtime.parent import ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED

_LAUNCHERS = (ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED)  # between the launcher and this process


def withhold(passwords: Iterable[str]) -> None:
    """Empty the variables ``passwords`` of this process, so that programs which it starts do not receive them.

    The variables remain set, so that such a program can read a config that names them.
    """
    for name in passwords:
        if name in os.environ:
            os.environ[name] = ""


def child_environment(*more: Mapping[str, str]) -> dict[str, str]:
    """Return this process's variables without the launcher's, with ``more`` added."""
    merged = {name: value for name, value in os.environ.items() if name not in _LAUNCHERS}
    for variables in more:
        merged |= variables
    return merged
