"""A channel under another topic, which an option of a script chooses: ``--topic`` and the like (paper Table A.6)."""

from msgspec.structs import replace

from pebble.contract.channels import CHANNELS, OUTGOING, Channel
from pebble.errors import ConfigError


def renamed(channel: Channel, topic: str, base: str) -> Channel:
    """``channel`` with the whole topic ``topic``; with "" as it is.

    Options come from remote operators, so that the topic must be one of the robot's own outgoing ones, and none that
    has another meaning. Raises ConfigError.
    """
    prefix = f"{base}/{OUTGOING}/"
    if not topic or topic == channel.topic(base):
        return channel
    metric = topic.removeprefix(prefix)
    if not topic.startswith(prefix) or not metric or any(character in metric for character in "+#{}"):
        raise ConfigError(f"topic {topic!r} must be below {prefix}")
    if any(other.filter(base) == topic or other.names(topic) for other in CHANNELS if other != channel):
        raise ConfigError(f"topic {topic!r} has another meaning already")
    return replace(channel, metric=metric, override=None)
