"""What the security level of a config refuses: ways to the robot without a login; and one hub for two uses."""

import re
from collections.abc import Iterator

from pebble.config.hosts import is_loopback
from pebble.config.problems import Notes, Path
from pebble.config.rules.exposure import brokers
from pebble.config.rules.shared_topics import renamed_commands
from pebble.config.transport import Mqtt, ZenohClient
from pebble.config.tree import Root

_ZENOH_ENCRYPTED = ("tls/", "quic/")
_ZENOH_LOCAL = ("unixsock-stream/", "unixpipe/", "vsock/")
_EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 -- compared only
_LAN: Path = ("services", "neighbours", "lan")
_BARE_HOST = re.compile(r"^[a-z0-9-]+/\[?([^\]/]*?)\]?(?::\d+)?(?:[?#].*)?$")


def check_doors(notes: Notes, root: Root) -> None:
    """Note what the level refuses. ``open`` refuses nothing."""
    if root.security.level == "open":
        return
    _check_links(notes, root)
    if root.security.level == "named" and root.robot.platform == "linux":
        _check_sides(notes, root)


def warning_of_open(root: Root) -> str:
    """What the level ``open`` means where other machines reach the robot; empty: none does, or it is another level."""
    hosts = [f"broker {mqtt.host}" for _, mqtt in _robots_brokers(root) if not is_loopback(mqtt.host)]
    places = [*hosts, *(endpoint for _, endpoint in _endpoints(root))]
    if root.security.level != "open" or not places:
        return ""
    return f'security.level is "open": whoever may publish by {places[0]} drives this robot (docs/ext/fleet.md)'


def _robots_brokers(root: Root) -> Iterator[tuple[Path, Mqtt]]:
    return (one for one in brokers(root) if one[0][0] != "web_interface")


def _check_links(notes: Notes, root: Root) -> None:
    level = root.security.level
    for path, mqtt in brokers(root):
        if is_loopback(mqtt.host):
            continue
        if not mqtt.tls.enabled and root.robot.platform != "esp8266":  # which has no memory for it
            notes.problem(
                (*path, "tls", "enabled"), f'must be true at security.level "{level}": {mqtt.host} is another machine'
            )
        if mqtt.tls.enabled and mqtt.tls.insecure:
            notes.problem((*path, "tls", "insecure"), f'must be false at security.level "{level}"')
        if not mqtt.username:
            notes.problem(
                (*path, "username"),
                f'is missing at security.level "{level}": `pebble fleet add NAME --role robot` makes an account',
            )
    for path, endpoint in _endpoints(root):
        if not endpoint.startswith(_ZENOH_ENCRYPTED):
            notes.problem(path, f'{endpoint} is not encrypted: write tls/… at security.level "{level}"')
    remote, lan = root.services.mqtt_bridge.remote, root.services.neighbours.lan
    links = {("mqtt_bridge", "remote"): "" if remote is None else remote.account, ("neighbours", "lan"): lan.account}
    for link, account in links.items():
        if not account and any(path[1:3] == link for path, _ in _endpoints(root)):
            notes.problem(
                ("services", *link, "account"),
                f'is missing at security.level "{level}": `pebble fleet certificate NAME` prints what belongs there',
            )


def check_lan(notes: Notes, root: Root) -> None:
    """Note where the hub of the LAN is also that of the operators, or of the robot itself."""
    sections = _zenoh_sections(root)
    lan = sections.pop(_LAN, None)
    meets = {_place(endpoint): endpoint for endpoint in (() if lan is None else lan.connect)}
    for path, key, endpoint in _each(sections):
        if (mine := meets.get(_place(endpoint))) is not None:
            other = ".".join(map(str, (*path, key)))
            why = f"is also {other}: what is shared would come twice, or without end; take another hub"
            notes.problem((*_LAN, "connect"), f"{mine} {why}")


def _endpoints(root: Root) -> Iterator[tuple[Path, str]]:
    """Those of Zenoh that lead beyond this machine."""
    for path, key, endpoint in _each(_zenoh_sections(root)):
        if not _is_near(endpoint):
            yield (*path, key), endpoint


def _zenoh_sections(root: Root) -> dict[Path, ZenohClient]:
    transport, bridge = root.transport, root.services.mqtt_bridge
    found: dict[Path, ZenohClient] = {("transport",): transport} if transport.kind == "zenoh" else {}
    if bridge.enabled and bridge.remote is not None and bridge.remote.kind == "zenoh":
        found["services", "mqtt_bridge", "remote"] = bridge.remote
    if root.services.neighbours.enabled:
        found[_LAN] = root.services.neighbours.lan
    return found


def _each(sections: dict[Path, ZenohClient]) -> Iterator[tuple[Path, str, str]]:
    for path, section in sections.items():
        yield from ((path, key, one) for key in ("listen", "connect") for one in getattr(section, key, ()))


def _place(endpoint: str) -> tuple[str, str]:
    """Host and port; all names of this machine are one."""
    host, _, port = re.sub(r"[?#].*", "", endpoint.partition("/")[2]).rpartition(":")
    host = host.strip("[]")
    return ("" if host in _EVERYWHERE or is_loopback(host) else host), port


def _is_near(endpoint: str) -> bool:
    host = _BARE_HOST.match(endpoint)
    return endpoint.startswith(_ZENOH_LOCAL) or (host is not None and is_loopback(host[1]))


def _check_sides(notes: Notes, root: Root) -> None:
    """At ``named`` the bridge knows the names, so nothing may go past it."""
    bridge, transport = root.services.mqtt_bridge, root.transport
    why = 'at security.level "named" the bridge checks names'
    if not bridge.enabled:
        notes.problem(("services", "mqtt_bridge", "enabled"), f"must be true: {why}")
    for path, _ in renamed_commands(root):
        notes.problem(path, f"cannot be renamed: {why}, by the contract's topics")
    for path, mqtt in _robots_brokers(root):
        if path[-1] != "remote_mqtt" and not is_loopback(mqtt.host):
            notes.problem((*path, "host"), f"must be on loopback: {why}, which are not checked at {mqtt.host}")
    for path, endpoint in _endpoints(root):
        if path[0] == "transport":
            notes.problem(path, f"{endpoint}: must be on loopback: {why}, which are not checked there")
    remote, local = bridge.remote_mqtt, root.local_mqtt
    if bridge.enabled and transport.kind == "mqtt" and bridge.remote is None and place_of(remote) == place_of(local):
        place = ("services", "mqtt_bridge", "remote_mqtt", "host")
        notes.problem(place, f"must be another broker than local_mqtt: {why}, between the two")


def place_of(mqtt: Mqtt) -> tuple[str, int]:
    """Return host and port; all names of this machine are one."""
    return ("" if is_loopback(mqtt.host) else mqtt.host), mqtt.port
