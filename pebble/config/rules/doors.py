"""Checks of the security level: every connection that would let a client in without a login is refused."""

import re
from collections.abc import Iterator

from pebble.config.hosts import is_loopback
from pebble.config.problems import Notes, Path
from pebble.config.rules.exposure import brokers, connections, core_connections
from pebble.config.rules.shared_topics import renamed_commands
from pebble.config.transport import Mqtt, ZenohClient
from pebble.config.tree import Root

ENCRYPTED = ("tls/", "quic/")  # endpoints of Zenoh
_ZENOH_LOCAL = ("unixsock-stream/", "unixpipe/", "vsock/")
_BARE_HOST = re.compile(r"^[a-z0-9-]+/\[?([^\]/]*?)\]?(?::\d+)?(?:[?#].*)?$")


def check_doors(notes: Notes, root: Root) -> None:
    """Note the connections that the level refuses. ``open`` refuses nothing."""
    if root.security.level == "open":
        return
    _check_links(notes, root)
    if root.security.level == "named" and root.robot.platform == "linux":
        _check_sides(notes, root)


def warning_of_open(root: Root) -> str:
    """Return a warning if the level is ``open`` and other machines reach the robot, or ""."""
    hosts = [f"broker {mqtt.host}" for _, mqtt in brokers(core_connections(root)) if not is_loopback(mqtt.host)]
    places = [*hosts, *(endpoint for _, endpoint in _endpoints(root))]
    if root.security.level != "open" or not places:
        return ""
    return f'security.level is "open": whoever may publish by {places[0]} drives this robot (docs/ext/fleet.md)'


def _check_links(notes: Notes, root: Root) -> None:
    level = root.security.level
    for path, mqtt in brokers(connections(root)):
        if is_loopback(mqtt.host):
            continue
        if not mqtt.tls.enabled and root.robot.platform != "esp8266":  # which has no memory for it
            why = f'must be true at security.level "{level}": {mqtt.host} is another machine'
            notes.problem((*path, "tls", "enabled"), why)
        if mqtt.tls.enabled and mqtt.tls.insecure:
            notes.problem((*path, "tls", "insecure"), f'must be false at security.level "{level}"')
        if not mqtt.username:
            why = f'is missing at security.level "{level}": `pebble fleet add NAME --role robot` makes an account'
            notes.problem((*path, "username"), why)
    for path, endpoint in _endpoints(root):
        if not endpoint.startswith(ENCRYPTED):
            notes.problem(path, f'{endpoint} is not encrypted: write tls/… at security.level "{level}"')
    for path, section in connections(root):
        leaves_machine = any(place[:-1] == path for place, _ in _endpoints(root))  # by an endpoint of this section
        if leaves_machine and getattr(section, "account", None) == "":
            why = f'is missing at security.level "{level}": `pebble fleet certificate NAME` prints what belongs there'
            notes.problem((*path, "account"), why)


def _endpoints(root: Root) -> Iterator[tuple[Path, str]]:
    """Yield the Zenoh endpoints that lead beyond this machine, with their places in the config."""
    return ((path, endpoint) for path, endpoint in zenoh_endpoints(root) if not _is_near(endpoint))


def zenoh_endpoints(root: Root) -> Iterator[tuple[Path, str]]:
    """Yield the endpoints of all connections by Zenoh, with their places in the config."""
    for path, section in connections(root):
        if isinstance(section, ZenohClient):
            for key in ("listen", "connect"):
                yield from (((*path, key), endpoint) for endpoint in getattr(section, key, ()))


def _is_near(endpoint: str) -> bool:
    host = _BARE_HOST.match(endpoint)
    return endpoint.startswith(_ZENOH_LOCAL) or (host is not None and is_loopback(host[1]))


def _check_sides(notes: Notes, root: Root) -> None:
    """Refuse connections that bypass the bridge, which alone checks the names of senders at the level ``named``."""
    bridge, transport = root.services.mqtt_bridge, root.transport
    why = 'at security.level "named" the bridge checks names'
    if not bridge.enabled:
        notes.problem(("services", "mqtt_bridge", "enabled"), f"must be true: {why}")
    for path, _ in renamed_commands(root):
        notes.problem(path, f"cannot be renamed: {why}, by the contract's topics")
    for path, mqtt in brokers(core_connections(root)):
        if path[-1] != "remote_mqtt" and not is_loopback(mqtt.host):  # of the robot's own programs
            notes.problem((*path, "host"), f"must be on loopback: {why}, which are not checked at {mqtt.host}")
    for path, endpoint in _endpoints(root):
        if path[0] == "transport":  # between the robot's own programs
            notes.problem(path, f"{endpoint}: must be on loopback: {why}, which are not checked there")
    remote, local = bridge.remote_mqtt, root.local_mqtt
    if bridge.enabled and transport.kind == "mqtt" and bridge.remote is None and place_of(remote) == place_of(local):
        place = ("services", "mqtt_bridge", "remote_mqtt", "host")
        notes.problem(place, f"must be another broker than local_mqtt: {why}, between the two")


def place_of(mqtt: Mqtt) -> tuple[str, int]:
    """Return host and port of a broker; the host is "" for every name of this machine."""
    return ("" if is_loopback(mqtt.host) else mqtt.host), mqtt.port
