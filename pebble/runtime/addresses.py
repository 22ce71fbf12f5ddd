"""The topic that a robot uses for each channel, by its config (paper Table A.6)."""

from typing import NamedTuple

from pebble.config import Config
from pebble.config.rules.shared_topics import topic_at
from pebble.contract import CHANNELS, Channel, channel_of


class Address(NamedTuple):
    """The effective topic and delivery of a channel."""

    topic: str  # of a pattern channel: a filter
    qos: int
    retain: bool


class Addresses:
    """A table of the addresses of all channels. ``config``: the robot's, or only its base if no topic is renamed."""

    def __init__(self, config: Config | str) -> None:
        self.base = config if isinstance(config, str) else config.base
        self._of = {
            channel: _default(channel, config) if isinstance(config, str) else _address(channel, config)
            for channel in CHANNELS
        }
        self._channels = {address.topic: channel for channel, address in self._of.items() if not channel.is_pattern}

    def __getitem__(self, channel: Channel) -> Address:
        """Return the address of a channel; a channel made at run time, outside the contract, has its own defaults."""
        address = self._of.get(channel)
        return address if address is not None else _default(channel, self.base)

    def channel(self, topic: str) -> Channel | None:
        """Return the channel with this topic, renamed or not; None if the contract does not know it."""
        renamed = self._channels.get(topic)
        if renamed is not None or not topic.startswith(self.base + "/"):
            return renamed
        channel = channel_of(topic[len(self.base) + 1 :])
        return channel if channel is not None and channel.is_pattern else None


def _address(channel: Channel, config: Config) -> Address:
    default = _default(channel, config.base)
    topic = None if channel.override is None else topic_at(config, channel.override.split("."))
    return default if topic is None else default._replace(topic=topic)


def _default(channel: Channel, base: str) -> Address:
    return Address(channel.filter(base), channel.default_qos, channel.default_retain)
