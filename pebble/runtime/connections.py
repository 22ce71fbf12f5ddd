"""The transports of a robot, made from its config: the local transport and the connections to operators."""

from collections.abc import Iterator
from dataclasses import replace as replace_settings
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble import contract as c
from pebble.config import Config, Mqtt, RemoteConnection, RemoteMqtt, Tls
from pebble.config.transport import ZenohClient
from pebble.errors import ConfigError, TransportError
from pebble.extension import programs_of
from pebble.runtime.addresses import Addresses
from pebble.transports import Message, MqttSettings, TlsSettings, Transport, ZenohSettings, check_kind, create
from pebble.transports.hosts import SMALL_SEGMENT
from pebble.transports.socket_paths import LONGEST_SOCKET, fits_socket

_ANY = "+/+/+"  # the levels of any robot
#: Topics of the robot's states, and of all commands: they are published even to a broker that hangs up on them.
_VITAL_STATES = (
    *(channel.filter(_ANY) for channel in (c.ONLINE, c.HEARTBEAT, c.CAPABILITIES, c.ESTOP_STATE)),
    f"{_ANY}/+/control/#",
)
ALL_VITAL = (*_VITAL_STATES, f"{_ANY}/{c.INCOMING}/#")

LOCAL_RECONNECT_S, REMOTE_RECONNECT_S = 0.5, 2.0
_BRIDGE, _STOPS = "remote-bridge", "remote-stops"
#: Classes of RFC 4594 for links that may be thin: traffic that must not wait, and traffic that is dropped late.
_EXPEDITED, _ASSURED = 46, 10


def local_transport(config: Config, name: str, *, will: Message | None = None, as_published: bool = False) -> Transport:
    """Return the local transport of the process called ``name``, not yet opened."""
    kind = config.transport.kind
    return create(kind, _name(config, kind, name), local_settings(config, as_published), will=will)


def check_connections(config: Config) -> None:
    """Raise ConfigError for mistakes that only the robot's machine can know: missing transports, long paths."""
    remote = config.services.mqtt_bridge.remote
    kinds = {"transport.kind": config.transport.kind}  # by config key
    if remote is not None:
        kinds["services.mqtt_bridge.remote.kind"] = remote.kind
    problems = []
    for key, kind in kinds.items():
        try:
            check_kind(kind)
        except TransportError as error:
            problems.append(f"{key}: {error}")
    programs = programs_of(config.installed, config)
    has_sockets = config.transport.kind == "zenoh" or any(program.has_sockets for program in programs)
    if has_sockets and not fits_socket(config.run_dir() / LONGEST_SOCKET):
        problems.append(
            f"transport.run_dir: {config.run_dir()} is too long for the sockets in it, set it to a shorter path"
        )
    if problems:
        raise ConfigError(problems)


def local_settings(config: Config, as_published: bool = False) -> Any:
    """Return the local transport's settings, a third party's as in the config. ``as_published``: see `MqttSettings`."""
    kind = config.transport.kind
    if kind == "mqtt":
        settings = mqtt_settings(config.local_mqtt, as_published=as_published, reconnect_max_s=LOCAL_RECONNECT_S)
        return replace_settings(settings, vital=(*ALL_VITAL, *_renamed_vital(config)))
    if kind == "zenoh":
        return zenoh_settings(config)
    return config.transport.settings


def remote_transport(config: Config, name: str, *, will: Message | None = None) -> Transport:
    """Return a connection to operators, not yet opened: to ``remote`` if it is set, else to ``remote_mqtt``."""
    bridge = config.services.mqtt_bridge
    if bridge.remote is None:
        remote = bridge.remote_mqtt
        program = "" if name == _BRIDGE else name
        settings = mqtt_settings(remote, as_published=True, reconnect_max_s=REMOTE_RECONNECT_S, program=program)
        settings = replace_settings(settings, vital=(*_VITAL_STATES, *_renamed_vital(config)))
        if bridge.link.profile != "wide":  # routers may send the bridge's packets before media
            settings = replace_settings(settings, dscp=_EXPEDITED if name == _BRIDGE else _ASSURED)
        return create("mqtt", _name(config, "mqtt", name), settings, will=will)
    kind = bridge.remote.kind
    return create(kind, _name(config, kind, name), _remote_settings(config, bridge.remote), will=will)


def stops_transport(config: Config) -> Transport | None:
    """Return the bridge's second connection to operators, only for stops; None if there is none.

    At the level ``open`` there is one only if the link may be thin: on such a link a client that sends too much fills
    the first connection. The second one is not opened ``as_published`` (see :class:`Message`).
    """
    bridge = config.services.mqtt_bridge
    if config.security.level == "open" and (bridge.remote is not None or bridge.link.profile == "wide"):
        return None
    if bridge.remote is None:
        settings = live_only(mqtt_settings(bridge.remote_mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program=_STOPS))
        return create("mqtt", _name(config, "mqtt", _STOPS), settings)
    if bridge.remote.kind != "zenoh":  # other transports may not allow a second connection
        return None
    return create("zenoh", _name(config, "zenoh", _STOPS), _remote_settings(config, bridge.remote))


def live_only(settings: MqttSettings) -> MqttSettings:
    """Return the settings of a connection that gets no retained messages (MQTT 5), which would delay the others."""
    return replace_settings(settings, max_segment=SMALL_SEGMENT, sends_retained=False)


def mirror_transport(config: Config, mirror: Mqtt, name: str) -> Transport:
    """Return the mirror's connection to the broker on the robot, not yet opened."""
    settings = mqtt_settings(mirror, as_published=True, reconnect_max_s=LOCAL_RECONNECT_S)
    return create("mqtt", _name(config, "mqtt", name), settings)


def _name(config: Config, kind: str, name: str) -> str:
    """Return the name of a program's transport, for logs and MQTT's client ids."""
    return f"{config.base}/{name.replace('-', '_')}" if kind == "mqtt" else f"{config.base}-{name}"


def _remote_settings(config: Config, remote: RemoteConnection) -> Any:
    """Return the settings of an uplink; with Zenoh those of a client of a hub elsewhere."""
    if remote.kind != "zenoh":
        return remote.settings
    return client_of_hub(config.run_dir() / "remote", remote, remote.lease_ms, remote.account)


def client_of_hub(run_dir: Path, hub: ZenohClient, lease_ms: int, account: str) -> ZenohSettings:
    """Return the settings of a client of a hub elsewhere."""
    return ZenohSettings(
        run_dir=run_dir,
        connect=tuple(hub.connect),
        tls=tls_settings(hub.tls),
        lease_ms=lease_ms,
        client=True,
        account=account,
    )


def zenoh_settings(config: Config, *, client: bool = False) -> ZenohSettings:
    """Return the settings of a Zenoh peer on this robot, or of a ``client`` for a short command."""
    return ZenohSettings(run_dir=config.run_dir(), lease_ms=config.transport.lease_ms, client=client)


def hub_settings(config: Config) -> ZenohSettings:
    """Return the settings of this robot's hub, with its endpoints for other machines and its journal."""
    transport = config.transport
    return ZenohSettings(
        run_dir=config.run_dir(),
        listen=tuple(transport.listen),
        connect=tuple(transport.connect),
        tls=tls_settings(transport.tls),
        allowed_names=transport.allowed_names,
        access=transport.access,
        lease_ms=transport.lease_ms,
        journal=transport.journal,
        of_robot=True,
        # A renamed topic, and True if a will on it is accepted: a hub knows the rules of the contract's topics only.
        wills=tuple(
            dict.fromkeys(
                (topic, channel.kind is c.Kind.FLAG)
                for channel, topic in _renamed(config)
                if channel.direction == c.INCOMING
            )
        ),
    )


def _renamed_vital(config: Config) -> tuple[str, ...]:
    vital = (c.ONLINE, c.CAPABILITIES, c.DRIVE, c.ESTOP, c.ESTOP_RESET)
    return tuple(dict.fromkeys(topic for channel, topic in _renamed(config) if channel in vital))


def _renamed(config: Config) -> Iterator[tuple[c.Channel, str]]:
    """Yield the channels that this config renames, and their topics, for every serial line."""
    section = config.services.serial_mcu_bridge  # of all lines; a process of one line has its own section here
    for line in (section, *config.serial_instances().values()):
        addresses = Addresses(replace(config, services=replace(config.services, serial_mcu_bridge=line)))
        for channel in c.CHANNELS:
            topic = addresses[channel].topic
            if topic != channel.filter(config.base):
                yield channel, topic


def mqtt_settings(
    mqtt: Mqtt, *, as_published: bool = False, reconnect_max_s: float, program: str = "tool"
) -> MqttSettings:
    """Return the settings of a connection to a broker of the config.

    A client id in the config is used by the bridge (``program=""``); ids of other programs begin with it.
    """
    client_id = mqtt.client_id if isinstance(mqtt, RemoteMqtt) else None
    return MqttSettings(
        host=mqtt.host,
        port=mqtt.port,
        username=mqtt.username,
        password=mqtt.password,
        password_file=mqtt.password_file,
        tls=tls_settings(mqtt.tls),
        client_id=f"{client_id}-{program}" if client_id and program else client_id,
        protocol=mqtt.protocol,
        as_published=as_published,
        reconnect_max_s=reconnect_max_s,
        silence_s=mqtt.silence_seconds,
        vital=ALL_VITAL,
    )


def tls_settings(tls: Tls) -> TlsSettings | None:
    """Return the certificates, or None if TLS is off."""
    if not tls.enabled:
        return None
    return TlsSettings(
        ca_cert=tls.ca_cert, client_cert=tls.client_cert, client_key=tls.client_key, insecure=tls.insecure
    )
