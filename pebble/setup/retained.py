"""Removes the retained messages of a robot that changes its name, or goes: other programs would go on showing it."""

import time
from collections.abc import Iterator
from contextlib import closing

from pebble.client.connection import Listener
from pebble.config import Config
from pebble.contract import CHANNELS
from pebble.errors import TransportError
from pebble.runtime.addresses import Addresses
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings
from pebble.transports import MqttSettings, QoS, State
from pebble.transports.mqtt.transport import MqttTransport

_OPEN_S, _LONGEST_S = 5.0, 10.0
_QUIET_S = 0.5  # brokers send what is retained at once, some a moment later


def topics(config: Config) -> Iterator[str]:
    """What the robot and its operators leave at the broker: topics, and filters of families of them. Never all."""
    addresses = Addresses(config)
    for channel in CHANNELS:
        address = addresses[channel]
        if address.retain and channel.remote:
            yield address.topic


def remove(config: Config) -> int:
    """Remove them with the robot's own login; returns how many there were. Raises TransportError."""
    mqtt = mqtt_settings(config.services.mqtt_bridge.remote_mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program="setup")
    return sum(_remove_at(one, list(topics(config))) for one in mqtt.each())


def _remove_at(settings: MqttSettings, filters: list[str]) -> int:
    client = MqttTransport("setup", settings)
    with closing(client):
        client.open(_OPEN_S)
        if client.state is not State.CONNECTED:
            raise TransportError(f"broker {settings.host}:{settings.port}: {client.problem or 'does not answer'}")
        return _remove(client, filters)


def _remove(client: MqttTransport, filters: list[str]) -> int:
    arrived = Listener(client, filters)
    found = set[str]()
    deadline = time.monotonic() + _LONGEST_S
    while time.monotonic() < deadline and (message := arrived.next(_QUIET_S)) is not None:
        if message.retain and message.payload:
            found.add(message.topic)
    for topic in found:
        client.publish(topic, b"", qos=QoS.DELIVERED, retain=True, remember=False)
    left = set(found)
    deadline = time.monotonic() + _LONGEST_S
    while left and (message := arrived.next(deadline - time.monotonic())) is not None:
        if not message.payload:
            left.discard(message.topic)
    if left:
        raise TransportError(f"the broker did not confirm that {len(left)} retained messages are removed")
    return len(found)
