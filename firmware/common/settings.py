"""The robot's identity, its Wi-Fi and its broker: /private_config.json, which never leaves the board. A driver."""

import json

_PATH = "/private_config.json"


def load() -> dict:
    """What the file says; {} if there is none that can be read: the robot stops its motors before it complains."""
    try:
        with open(_PATH) as file:
            return json.load(file)
    except (OSError, ValueError):
        return {}


def get(settings: dict, section: str, name: str, default=None):
    """One setting; ValueError if it is missing and has no default."""
    value = settings.get(section, {}).get(name, default)
    if value is None:
        raise ValueError("private_config.json lacks " + section + "." + name)
    return value
