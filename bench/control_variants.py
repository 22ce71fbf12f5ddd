"""The variants of sending a command between two services, and their settings."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """``kind`` is a transport, or ``paho``; ``broker`` holds lines of mosquitto's configuration."""

    about: str
    kind: str
    protocol: str = "3.1.1"
    broker: tuple[str, ...] = ()
    client: bool = False  # Zenoh client mode: everything goes through the hub

    @property
    def on_zenoh(self) -> bool:
        return self.kind == "zenoh"


_NODELAY = ("set_tcp_nodelay true",)
VARIANTS = {
    "paho": Variant(about="stock paho at both ends, stock mosquitto: TCP_NODELAY nowhere", kind="paho"),
    "mqtt": Variant(about="Pebble's MQTT transport (TCP_NODELAY), stock mosquitto (without)", kind="mqtt"),
    "mqtt-nodelay": Variant(about="the same, with TCP_NODELAY in the broker", kind="mqtt", broker=_NODELAY),
    "mqtt5": Variant(about="MQTT 5, TCP_NODELAY on both sides", kind="mqtt", protocol="5", broker=_NODELAY),
    "zenoh-p2p": Variant(about="Pebble's Zenoh transport, peer to peer", kind="zenoh"),
    "zenoh-hub": Variant(about="the same, through the hub", kind="zenoh", client=True),
}
BASELINE = "mqtt"
P2P, HUB = "zenoh-p2p", "zenoh-hub"
MQTT = tuple(name for name, variant in VARIANTS.items() if not variant.on_zenoh)
