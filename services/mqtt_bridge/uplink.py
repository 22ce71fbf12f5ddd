"""The way to the remote broker, as the bridge uses it: it carries everything, unless an extension knows better."""

from __future__ import annotations

from collections.abc import Callable

from pebble.config import Config
from pebble.contract import Channel
from pebble.errors import ConfigError
from pebble.extension import part
from pebble.forwarding.forwarder import Forwarder
from pebble.runtime.addresses import Addresses
from pebble.runtime.parent import Notifier
from pebble.transports import Transport

POLL_S = 0.1


class Uplink:
    """A wide link, over which nothing waits. Methods that an extension overrides run on the service's thread."""

    channels: tuple[Channel, ...] = ()  # that it publishes on the remote side itself

    @property
    def is_flooded(self) -> bool:
        """True if a client lately sent more commands than the link carries."""
        return False

    @property
    def heartbeat_qos(self) -> int | None:
        """The QoS of heartbeats; None for the configured QoS."""
        return None

    def heartbeat_due(self) -> bool:
        """Return True if a heartbeat is due, and there is room for it on the link."""
        return True

    def pause(self, seconds: float) -> float:
        """Return the time to wait between two requests that are not urgent; ``seconds`` on a wide link."""
        return seconds

    def poll(self) -> bool:
        """Measure the link and send waiting messages, every POLL_S; True if heartbeats are sent with these polls."""
        return False

    def note_drive(self, payload: bytes) -> None:
        """Note a drive command that has come over the link. Any thread may call this."""


def uplink_of(
    config: Config, addresses: Addresses, remote: Transport, forwarder: Forwarder, clock: Callable[[], float]
) -> Uplink:
    """Return the uplink of a robot. Raises ConfigError if it is not plain and no extension provides that."""
    link = config.services.mqtt_bridge.link
    if link.profile == "wide" and not link.groups:
        return Uplink()
    for extension in config.installed:
        if extension.uplink:
            uplink: Uplink = part(extension.uplink)(config, addresses, remote, forwarder, Notifier(), clock)
            return uplink
    raise ConfigError('services.mqtt_bridge.link: is of the extension thin: pip install "pebble-robot[all]"')
