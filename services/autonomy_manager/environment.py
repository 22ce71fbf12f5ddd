"""The environment variables of a script."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pebble.config import Config
from pebble.extensions.scripts.runs import CONFIG, RUN
from pebble.runtime.environment import child_environment
from pebble.services.autonomy_manager.interpreter import SYSTEM


def environment(*more: Mapping[str, str], ours: bool = True) -> dict[str, str]:
    """Return this process's variables with ``more`` added.

    For foreign scripts (``ours`` False) ``python3`` is the system's, even if Pebble's comes first in PATH.
    """
    merged = {"PYTHONUNBUFFERED": "1"}  # else what it prints comes in blocks, long after
    merged |= child_environment()
    for name in (RUN, CONFIG):  # which run and which robot: only ``more`` says that
        merged.pop(name, None)
    if not ours and sys.prefix != sys.base_prefix and SYSTEM.is_file():
        pebbles = str(Path(sys.prefix, "bin"))
        places = merged.get("PATH", "").split(os.pathsep)
        others = [place for place in places if place != pebbles]
        merged["PATH"] = os.pathsep.join(others + [place for place in places if place == pebbles])
        merged.pop("VIRTUAL_ENV", None)
    for variables in more:
        merged |= variables
    return merged


def local_login(config: Config) -> dict[str, str]:
    """Return the variable with the password of the robot's own broker, for a script that connects by itself."""
    local = config.local_mqtt
    if config.transport.kind != "mqtt" or local.password_env is None:
        return {}
    return {local.password_env: str(local.password or "")}
