"""The connections of a gateway."""

from pathlib import Path

from pebble import contract as c
from pebble.config import Mqtt
from pebble.extensions.fleet.gateway.gateway_file import GatewayFile
from pebble.runtime.connections import (
    LOCAL_RECONNECT_S,
    REMOTE_RECONNECT_S,
    client_of_hub,
    live_only,
    mqtt_settings,
)
from pebble.transports import Message, Transport, create


def gateway_transports(
    gateway: GatewayFile, operators: Mqtt, run_dir: Path, will: Message
) -> tuple[Transport, Transport, Transport, Transport]:
    """Return a gateway's connections: one to the robots' hub, three to the operators' broker.

    Of the three, one is for its heartbeats with its will, and one for stops.
    """
    base = will.topic.removesuffix(f"/{c.ONLINE.suffix}")
    forwards = mqtt_settings(operators, as_published=True, reconnect_max_s=REMOTE_RECONNECT_S)
    apart = mqtt_settings(operators, reconnect_max_s=REMOTE_RECONNECT_S)
    return (
        _robots_transport(gateway, base, run_dir),
        create("mqtt", f"{base}/forwards", forwards),
        create("mqtt", f"{base}/presence", apart, will=will),
        create("mqtt", f"{base}/stops", live_only(apart)),
    )


def _robots_transport(gateway: GatewayFile, base: str, run_dir: Path) -> Transport:
    if gateway.boards is not None:
        settings = mqtt_settings(gateway.boards, as_published=True, reconnect_max_s=LOCAL_RECONNECT_S)
        return create("mqtt", f"{base}/boards", settings)
    hub = gateway.hub
    return create("zenoh", f"{base}-hub", client_of_hub(run_dir, hub, hub.lease_ms, hub.account))
