"""The bridge's view of the way to the remote broker: wide, unless an extension replaces it."""

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
    """A wide link, on which nothing waits. Methods that an extension overrides run on the service's thread."""

    channels: tuple[Channel, ...] = ()  # that it publishes on the remote side itself

    @property
    def is_flooded(self) -> bool:
        """True if a client has recently sent more commands than the link carries."""
        return False

    @property
    def heartbeat_qos(self) -> int | None:
        """The QoS of heartbeats; None for the configured QoS."""
        return None

    def heartbeat_due(self) -> bool:
        """True if a heartbeat is due, and the link has room for it."""
        return True

    def pause(self, seconds: float) -> float:
        """Return the time to wait between two requests that are not urgent; on a wide link ``seconds``."""
        return seconds

    def poll(self) -> bool:
        """Measure the link and send waiting messages, every POLL_S; return True to have :meth:`heartbeat_due` asked."""
        return False

    def note_drive(self, payload: bytes) -> None:
        """Note a drive command that has come over the link. Any thread may call this."""


def uplink_of(
    config: Config, addresses: Addresses, remote: Transport, forwarder: Forwarder, clock: Callable[[], float]
) -> Uplink:
    """Return the uplink of a robot. Raises ConfigError if its link may be thin and no extension supports that."""
    link = config.services.mqtt_bridge.link
    if link.profile == "wide" and not link.groups:
        return Uplink()
    for extension in config.installed:
        if extension.uplink:
            uplink: Uplink = part(extension.uplink)(config, addresses, remote, forwarder, Notifier(), clock)
            return uplink
    raise ConfigError('services.mqtt_bridge.link: is of the extension thin: pip install "pebble-robot[all]"')
