"""What a config comes to, in a few lines and one table per process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from pebble.addresses import Addresses
from pebble.config import Config, Mqtt, RemoteLink
from pebble.contract import CHANNELS, MEDIA_STATUS, STATUS, TOUCH_SENSORS, Channel
from pebble.launcher.programs import programs
from pebble.process import view_of

_LAUNCHER = "launcher"
_MEDIA = {
    "camera_publisher": "video_publisher",
    "audio_publisher": "audio_publisher",
    "audio_receiver": "audio_receiver",
}
#: What nobody can rename.
_FIXED = {_LAUNCHER: STATUS, "av_daemon": MEDIA_STATUS}


class TopicLine(NamedTuple):
    """One channel of one process, under the name that the config gives it."""

    channel: Channel
    topic: str
    qos: int
    kept: bool
    renamed: bool


def facts(config: Config) -> list[tuple[str, str]]:
    """What it is about, line by line: the transport, the links, the processes. Nothing secret."""
    if config.robot.platform != "linux":
        firmware = f"runs on its own MCU ({config.robot.platform}), not by `pebble up`"
        return [("platform", firmware), ("broker", _mqtt(config.local_mqtt))]
    found = [("transport", _transport(config))]
    if config.transport.mqtt_mirror is not None:
        found.append(("mirror", _mqtt(config.transport.mqtt_mirror)))
    if config.services.mqtt_bridge.enabled:
        found.append(("uplink", _uplink(config)))
    found += [("serial", line) for line in _serial_lines(config)]
    table = programs(config)
    found.append(("processes", ", ".join([_LAUNCHER, *(program.name for program in table if not program.on_demand)])))
    on_request = ", ".join(program.name for program in table if program.on_demand)
    return [*found, ("on request", on_request)] if on_request else found


def topics_of(config: Config) -> Iterator[tuple[str, list[TopicLine]]]:
    """The processes that speak or listen, each with its topics."""
    for name in (_LAUNCHER, *(program.name for program in programs(config))):
        service, _, instance = name.partition(":")
        lines = _lines(view_of(config, instance), service)
        if lines:
            yield name, lines


def _lines(config: Config, service: str) -> list[TopicLine]:
    addresses = Addresses(config)
    mine = [channel for channel in CHANNELS if _is_of(channel, service) or channel is _FIXED.get(service)]
    if service == "serial_mcu_bridge":
        mine = [channel for channel in mine if _is_of_line(channel, config)]
    return [
        TopicLine(channel, topic, qos, kept, topic != channel.topic(config.base))
        for channel in mine
        for topic, qos, kept in [addresses[channel]]
    ]


def _is_of(channel: Channel, service: str) -> bool:
    """The path that renames a channel begins with the service whose it is; media programs have the bridge's."""
    path = "" if channel.override is None else channel.override.topic
    if service in _MEDIA:
        return path == f"services.mqtt_bridge.media.{_MEDIA[service]}.topic"
    return path.startswith(f"services.{service}.") and ".media." not in path


def _is_of_line(channel: Channel, config: Config) -> bool:
    line = config.services.serial_mcu_bridge
    if channel is TOUCH_SENSORS and not line.telemetry.publish_touch_sensors:
        return False
    return channel.metric.startswith("sensors/") == (line.protocol != "goob_base_v1")


def _transport(config: Config) -> str:
    kind = config.transport.kind
    if kind == "mqtt":
        return f"mqtt, {_mqtt(config.local_mqtt)}"
    journal = config.transport.journal
    kept = "kept state in memory" if journal is None else f"kept state in {journal}"
    return f"{kind}, run directory {config.run_dir()}, {kept}"


def _uplink(config: Config) -> str:
    bridge = config.services.mqtt_bridge
    if bridge.remote is not None and bridge.remote.kind != "mqtt":
        return _link(bridge.remote)
    return f"mqtt, {_mqtt(bridge.remote_mqtt)}"


def _link(link: RemoteLink) -> str:
    ways = [f"listens on {one}" for one in link.listen] + [f"connects to {one}" for one in link.connect]
    return ", ".join([link.kind, *ways])


def _mqtt(mqtt: Mqtt) -> str:
    user = "anonymous" if mqtt.username is None else f"user {mqtt.username}"
    password = "" if mqtt.username is None or mqtt.password is None else ", password ***"
    tls = "TLS" if mqtt.tls.enabled else "not encrypted"
    return f"{mqtt.host}:{mqtt.port}, MQTT {mqtt.protocol}, {user}{password}, {tls}"


def _serial_lines(config: Config) -> Iterator[str]:
    for name, line in config.serial_instances().items():
        own = f"{name}: " if name else ""
        drives = line.protocol == "goob_base_v1"
        stop = f", stops {line.safety.drive_timeout_seconds:g} s after the last command" if drives else ""
        yield f"{own}{line.protocol} at {line.serial.port}, {line.serial.baud} baud{stop}"
