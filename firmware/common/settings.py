"""The robot's identity, Wi-Fi and broker, from /private_config.json, which never leaves the board. A driver."""

import json


def load(path: str = "/private_config.json") -> dict:
    """Return the settings in the file. Raises nothing, as the motors must stop before :func:`get` reports an error."""
    try:
        with open(path) as file:
            if file.read(1) != "\ufeff":  # which some editors write first
                file.seek(0)
            return dict(json.load(file))
    except OSError:
        return {}
    except (ValueError, TypeError):  # of UTF-16, too
        return {"": 0}  # tells get() that the file cannot be read: no file has this key


def get(settings: dict, section: str, name: str, default=None):
    """Return a setting. Raises ValueError if it is missing and has no default, or if the file could not be read."""
    try:
        value = settings.get(section, {}).get(name, default)
    except AttributeError:
        value = None
    if value is None or "" in settings:  # "": the file could not be read, see load
        what = "is no JSON" if "" in settings else "lacks " + section + "." + name
        raise ValueError("private_config.json " + what)
    return value


def host(settings: dict) -> str:
    """Return the broker's name or IPv4 address. Raises ValueError that repeats nothing: a login may be in it."""
    name = get(settings, "mqtt", "host")
    for char in name if isinstance(name, str) and name else "/":
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
