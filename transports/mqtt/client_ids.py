"""Client ids, which identify connections at a broker. Pure but for random digits."""

import re
import secrets
from hashlib import sha256

_OTHER = re.compile(r"[^A-Za-z0-9_-]")  # some brokers refuse dots, blanks or slashes


def unique(name: str) -> str:
    """Return ``name`` (``pebble_robots_goob_remote_bridge``) and 16 random digits: an id that cannot be guessed.

    A broker closes the connection of a client when another one connects with its id (MQTT-3.1.4-2).
    """
    return f"{_escaped(name)}-{secrets.token_hex(8)}"


def _escaped(name: str) -> str:
    """Return the name in letters that all brokers accept, with a hash if another name could become equal."""
    text = _OTHER.sub("_", name)
    if text == name.replace("/", "_"):
        return text
    return f"{text}-{sha256(name.encode(errors='surrogatepass')).hexdigest()[:6]}"
