"""The environment variables of a script."""

from collections.abc import Mapping

from pebble.config import Config
from pebble.extensions.scripts.runs import CONFIG, RUN
from pebble.runtime.environment import child_environment


def environment(*more: Mapping[str, str]) -> dict[str, str]:
    """This process's variables and ``more`` of them; later ones replace earlier ones."""
    merged = {"PYTHONUNBUFFERED": "1", **child_environment()}  # else what it prints comes in blocks, long after
    for name in (RUN, CONFIG):
        merged.pop(name, None)
    for variables in more:
        merged |= variables
    return merged


def local_login(config: Config) -> dict[str, str]:
    """The variable with the password of the robot's own broker, for a script that connects to it itself."""
    local = config.local_mqtt
    if config.transport.kind != "mqtt" or local.password_env is None:
        return {}
    return {local.password_env: str(local.password or "")}
