"""The environment variables of a script."""

from __future__ import annotations

import os
from collections.abc import Mapping

from pebble.runtime.parent import ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED
from pebble.runtime.runs import CONFIG, RUN

_LAUNCHERS = (ENCODING, LAUNCHER_PID, NOTIFY_FD, WANTED)  # between the launcher and this process


def environment(*more: Mapping[str, str]) -> dict[str, str]:
    """This process's variables and ``more`` of them; later ones replace earlier ones."""
    inherited = {name: value for name, value in os.environ.items() if name not in (*_LAUNCHERS, RUN, CONFIG)}
    merged = {"PYTHONUNBUFFERED": "1", **inherited}  # else what it prints comes in blocks, long after the event
    for variables in more:
        merged |= variables
    return merged
