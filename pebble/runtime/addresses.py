"""The topic that one robot uses for each channel, after its config (paper Table A.6)."""

from typing import Any, NamedTuple

from pebble.config import Config
from pebble.contract import CHANNELS, Channel, channel_of


class Address(NamedTuple):
    """The effective topic and delivery of a channel."""

    topic: str  # of a pattern channel: a filter
    qos: int
    retain: bool


class Addresses:
    """Looks up the address of a channel, and the channel of a topic.

    ``config``: that of the robot, or its base if it renames nothing.
    """

    def __init__(self, config: Config | str) -> None:
        self.base = config if isinstance(config, str) else config.base
        self._of = {
            channel: _default(channel, config) if isinstance(config, str) else _address(channel, config)
            for channel in CHANNELS
        }
        self._channels = {address.topic: channel for channel, address in self._of.items() if not channel.is_pattern}

    def __getitem__(self, channel: Channel) -> Address:
        """Return where a channel travels; one that is made while running, in no contract, has its own defaults."""
        found = self._of.get(channel)
        return found if found is not None else _default(channel, self.base)

    def channel(self, topic: str) -> Channel | None:
        """Return the channel that travels under ``topic``, renamed or not; None for one the contract does not know."""
        renamed = self._channels.get(topic)
        if renamed is not None or not topic.startswith(self.base + "/"):
            return renamed
        known = channel_of(topic[len(self.base) + 1 :])
        return known if known is not None and known.is_pattern else None


def _address(channel: Channel, config: Config) -> Address:
    default = _default(channel, config.base)
    topic = None if channel.override is None else _at(config, channel.override)
    return default if topic is None else default._replace(topic=topic)


def _default(channel: Channel, base: str) -> Address:
    return Address(channel.filter(base), channel.default_qos, channel.default_retain)


def _at(config: Config, path: str) -> str | None:
    """Return the topic at a dotted path of the config tree; None where the key was not set."""
    value: Any = config
    for name in path.split("."):
        value = getattr(value, name, None)  # an extension's section is missing with it
    topic: str | None = value
    return topic
