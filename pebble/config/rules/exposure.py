"""Warnings about secrets of a config that other users can read, or that can be overheard."""

import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path as FilePath

from pebble.config.hosts import is_loopback
from pebble.config.problems import Notes, Path
from pebble.config.transport import Mqtt
from pebble.config.tree import Root
from pebble.config.types import Section


def warn_if_readable(notes: Notes, path: Path, file: FilePath, what: str) -> None:
    """Warn if every user of this machine can read ``file``, which is or holds ``what``."""
    if not hasattr(os, "getuid"):  # Windows has no such modes
        return
    try:
        mode = file.stat().st_mode
    except OSError:
        return
    if mode & stat.S_IROTH:
        notes.warning(path, f"every user of this machine can read {what}: run `chmod o-rwx {file}`")


def warn_of_logins_in_clear(notes: Notes, root: Root) -> None:
    """Warn of each broker on the network that receives a user name and a password without encryption."""
    for path, mqtt in brokers(connections(root)):
        if mqtt.username is not None and not mqtt.tls.enabled and not is_loopback(mqtt.host):
            fix = "set tls.enabled"
            if root.robot.platform == "esp8266":
                fix = "this board has no TLS, so give it a login of its own that may do nothing else"
            notes.warning((*path, "username"), f"its password crosses the network unencrypted: {fix}")


def warn_of_known_id(notes: Notes, root: Root) -> None:
    """Warn of a client id in the config: another client that logs in with it ends the robot's connection."""
    bridge = root.services.mqtt_bridge
    path = ("services", "mqtt_bridge", "remote_mqtt", "client_id")
    if root.security.level != "open" and bridge.enabled and bridge.remote is None and bridge.remote_mqtt.client_id:
        risk = "each account of the broker that knows this id can end the robot's connection with it"
        notes.warning(path, f"{risk}: leave it out, unless the broker lets only this account use it")


def brokers(connections: Iterable[tuple[Path, Section]]) -> Iterator[tuple[Path, Mqtt]]:
    """Yield the brokers among ``connections`` of the robot's programs, with their places in the config."""
    return ((path, section) for path, section in connections if isinstance(section, Mqtt))


def connections(root: Root) -> Iterator[tuple[Path, Section]]:
    """Yield all sections of connections in use, those of extensions included, with their places in the config."""
    yield from core_connections(root)
    for place, holder in ((("services",), root.services), ((), root)):
        for name in holder.__struct_fields__:
            section = getattr(holder, name)
            if isinstance(section, Section):
                for path, connection in section.connections():
                    yield (*place, name, *path), connection


def core_connections(root: Root) -> Iterator[tuple[Path, Section]]:
    """Yield the connections of the core: inside the robot, and to operators."""
    bridge, transport = root.services.mqtt_bridge, root.transport
    if transport.kind == "mqtt":
        yield ("local_mqtt",), root.local_mqtt
    if transport.mqtt_mirror is not None:
        yield ("transport", "mqtt_mirror"), transport.mqtt_mirror
    if transport.kind == "zenoh":
        yield ("transport",), transport
    if bridge.enabled and (bridge.remote is None or bridge.remote.kind == "mqtt"):
        yield ("services", "mqtt_bridge", "remote_mqtt"), bridge.remote_mqtt
    if bridge.enabled and bridge.remote is not None and bridge.remote.kind == "zenoh":
        yield ("services", "mqtt_bridge", "remote"), bridge.remote
