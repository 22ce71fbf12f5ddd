"""The robot's identity, Wi-Fi and broker, from /private_config.json, which never leaves the board. A driver."""

import json

_PATH = "/private_config.json"


def load() -> dict:
    """Read the file; {} if that fails: the robot must stop its motors before it reports missing settings."""
    try:
        with open(_PATH) as file:
            if file.read(1) != "\ufeff":  # which some editors write first
                file.seek(0)
            return json.load(file)
    except (OSError, ValueError):
        return {}


def get(settings: dict, section: str, name: str, default=None):
    """Return one setting. Raises ValueError if it is missing and has no default."""
    value = settings.get(section, {}).get(name, default)
    if value is None:
        raise ValueError("private_config.json lacks " + section + "." + name)
    return value


def host(settings: dict) -> str:
    """Return the broker's name or IPv4 address. Raises ValueError, which repeats nothing: a login may be in it."""
    name = get(settings, "mqtt", "host")
    for char in name or " ":
        if char in "/:@[]*,%\\" or not " " < char < "\x7f":
            raise ValueError("mqtt.host must be a name or address alone: write broker.example, and port beside it")
    return name


def base(system: str, kind: str, name: str) -> bytes:
    """Return the base of the robot's topics (paper A.4.1), before /incoming/{metric} and /outgoing/{metric}."""
    for part in (system, kind, name):
        for char in part or "/":
            if char in '/+#"\\' or char < " ":
                raise ValueError("not a name for a topic: " + repr(part))
    return b"%s/%s/%s" % (system.encode(), kind.encode(), name.encode())
