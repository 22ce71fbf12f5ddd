"""Checks between keys, and of files and passwords on this machine."""

import re
from pathlib import Path as FilePath

from msgspec.structs import asdict, replace

from pebble.config.problems import Notes, Path
from pebble.config.reader import Reader, Rule
from pebble.config.rules.doors import ENCRYPTED, check_doors
from pebble.config.rules.exposure import warn_if_readable, warn_of_known_id, warn_of_logins_in_clear
from pebble.config.rules.shared_topics import shared_topics
from pebble.config.text_files import NotTextError, text_of
from pebble.config.transport import Mqtt, RemoteMqtt, Tls, TransportSection
from pebble.config.tree import MqttBridge, Root, SerialBridge
from pebble.config.types import Secret
from pebble.contract.identity import GATEWAYS, SERVERS
from pebble.errors import PebbleError
from pebble.ownership import read_for

#: Words in commands of the original Pebble's configs, each with why it does harm, or nothing, here.
_WORDS_OF_ORIGINAL = (
    (re.compile(r"\bpebble-control\b").search, "starts the original, too, at the same serial port"),
    (re.compile(r"(?:^|[\s/])(?:sudo|doas|pkexec)\b").search, "needs a right that our unit denies"),
    (re.compile(r"\bgit\b.*\b(?:pull|fetch|merge|reset)\b").search, "updates Pebble only if it runs from that folder"),
)
#: The commands to write instead, by section, for our unit of systemd.
_COMMANDS_OF_UNIT = {
    "reboot_control": "systemctl --no-ask-password reboot",
    "service_restart_control": "systemctl --no-block restart pebble.service",
    "git_pull_control": "systemctl --no-ask-password start pebble-update.service",
}
_LONGEST_TEXT = 65535  # bytes of a user name or password (MQTT 3.1.1, section 1.5.3)
_VARIABLE = re.compile("[A-Z_][A-Z0-9_]*").fullmatch  # the usual form; another text may be a password
_INSTANCE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,32}").fullmatch  # it becomes part of a process's name and client id


def _root(reader: Reader, root: Root, _path: Path) -> Root:
    root = _without_uplink(reader.notes, root)
    kind, platform = root.transport.kind, root.robot.platform
    if root.transport.mqtt_mirror is not None and kind != "zenoh":
        why = f'only a Zenoh robot has a mirror and kind is "{kind}": leave it out'
        reader.notes.doubt(("transport", "mqtt_mirror"), why)  # a problem, unless a noted one may be its cause
    if root.robot.type in (SERVERS, GATEWAYS):
        reader.notes.problem(("robot", "type"), f'must not be "{root.robot.type}": those are no robots')
    if platform != "linux" and kind != "mqtt":
        reader.notes.doubt(("transport", "kind"), f'must be "mqtt" where robot.platform is "{platform}"')
    if not reader.notes.problems:  # else a default may stand for a refused topic, host or id
        for path, channel in shared_topics(root):
            reader.notes.problem(path, f"is also the topic of {channel.suffix}, choose another")
        warn_of_logins_in_clear(reader.notes, root)
        warn_of_known_id(reader.notes, root)
    check_doors(reader.notes, root)
    return root


def _transport(reader: Reader, transport: TransportSection, path: Path) -> TransportSection:
    """Check that a Zenoh robot which other machines reach is encrypted: certificates decide who may connect."""
    listens = [endpoint for endpoint in transport.listen if endpoint.startswith(ENCRYPTED)]
    connects = [endpoint for endpoint in transport.connect if endpoint.startswith(ENCRYPTED)]
    if transport.allowed_names is not None and not (listens or connects):
        reader.notes.warning((*path, "allowed_names"), "has no effect: no tls/ or quic/ endpoint is listed")
    if transport.allowed_names is not None and transport.access is not None:
        reader.notes.problem((*path, "allowed_names"), "must be left out: access says what each name may do")
    if transport.kind != "zenoh" or not listens:
        return transport
    if not transport.tls.enabled:
        reader.notes.doubt((*path, "tls", "enabled"), f"must be true, {listens[0]} needs certificates")
    elif transport.tls.ca_cert is None:
        reader.notes.doubt(
            (*path, "tls", "ca_cert"),
            f"is missing: without it anybody may connect to {listens[0]}; "
            "write the authority that signs the certificates of those who may",
        )
    return transport


def _bridge(reader: Reader, bridge: MqttBridge, path: Path) -> MqttBridge:
    notes, remote, link = reader.notes, bridge.remote, bridge.link
    for section, command_of_unit in _COMMANDS_OF_UNIT.items():  # warns of commands taken over from the original
        words = " ".join(getattr(bridge, section).command)
        reasons = [reason for occurs_in, reason in _WORDS_OF_ORIGINAL if occurs_in(words)]
        if bridge.enabled and reasons:
            notes.warning((*path, section, "command"), f"{', and '.join(reasons)}: write `{command_of_unit}`")
    if link.kbit is not None and link.profile == "wide":
        why = 'has no effect at profile "wide": write "thin" or "auto", or leave it out'
        notes.problem((*path, "link", "kbit"), why)
    if link.profile == "auto" and remote is not None and remote.kind != "mqtt":
        why = f'cannot be "auto": only MQTT connections are measured, and remote.kind is "{remote.kind}"; write "thin"'
        notes.problem((*path, "link", "profile"), why)
    if remote is not None and remote.kind != "mqtt":
        if bridge.remote_mqtt.host:
            notes.warning((*path, "remote_mqtt"), f'not used: remote.kind is "{remote.kind}"')
        if remote.kind == "zenoh" and not remote.connect:
            notes.doubt((*path, "remote", "connect"), "is missing, write the endpoint of the operators' hub")
        if remote.kind == "zenoh" and remote.listen:
            notes.problem((*path, "remote", "listen"), "an uplink only connects: leave it out")
        if remote.account and (not remote.tls.enabled or remote.tls.client_cert is None):
            notes.problem((*path, "remote", "account"), "needs tls.client_cert, in which it is the name")
    return bridge


def _without_uplink(notes: Notes, root: Root) -> Root:
    """Return ``root`` with the robot's own broker as the bridge's remote broker, if no remote host is set.

    Operators connect to that broker in the original's examples. A Zenoh robot has no broker: its bridge is disabled.
    """
    bridge, transport = root.services.mqtt_bridge, root.transport
    if not bridge.enabled or bridge.remote_mqtt.host or (bridge.remote is not None and bridge.remote.kind != "mqtt"):
        return root
    path = ("services", "mqtt_bridge", "remote_mqtt", "host")
    if root.robot.platform != "linux":
        notes.doubt(path, "is missing, write the name of the remote broker")
        return root
    local = root.local_mqtt if transport.kind == "mqtt" else transport.mqtt_mirror
    if local is None:
        notes.warning(path, "is empty: there is no uplink, so no operator sees or drives this robot")
        bridge = replace(bridge, enabled=False)
    else:
        notes.warning(path, f"is empty: there is no uplink, operators connect to the robot's own broker, {local.host}")
        bridge = replace(bridge, remote_mqtt=RemoteMqtt(**asdict(local), client_id=bridge.remote_mqtt.client_id))
    return replace(root, services=replace(root.services, mqtt_bridge=bridge))


def _serial(reader: Reader, serial: SerialBridge, path: Path) -> SerialBridge:  # each line: its own port and name
    if "instances" in path:  # the section of an instance
        if serial.instances:
            reader.notes.problem((*path, "instances"), "must be left out: an instance has none")
        return serial
    lines = {(*path, "instances", name): line for name, line in serial.instances.items()}
    if serial.serial.port is not None or not any(line.enabled for line in lines.values()):
        lines = {path: serial, **lines}  # the section itself is a line, and not only what instances share
    ports: dict[str, str] = {}  # names of lines by their ports
    for place, line in lines.items():
        port = line.serial.port
        if not line.enabled:
            continue
        if port is None:  # a doubt: it may have been refused, which is noted already
            reader.notes.doubt((*place, "serial", "port"), "is missing, write the device: ls /dev/serial/by-id/*")
        elif port in ports:
            reader.notes.problem(place, f"shares {port} with {ports[port]}, write another serial.port")
        else:
            ports[port] = str(place[-1])
    for name in serial.instances:
        if not _INSTANCE_NAME(name):
            reader.notes.problem((*path, "instances", name), "must be named with 1 to 32 of A-Z a-z 0-9 _ . -")
    if path in lines and "serial" in serial.instances:
        reader.notes.problem((*path, "instances", "serial"), "is what the line of this section is called, rename it")
    return serial


def _tls(reader: Reader, tls: Tls, path: Path) -> Tls:
    files = {key: getattr(tls, key) for key in ("ca_cert", "client_cert", "client_key")}
    named = {key: file for key, file in files.items() if file is not None}
    if not tls.enabled:
        if named:
            reader.notes.warning((*path, "enabled"), f"is false: nothing is encrypted, {', '.join(named)} unused")
        return tls
    for key, file in named.items():
        _contents(reader, file, (*path, key))
    if tls.client_key is not None:
        warn_if_readable(reader.notes, (*path, "client_key"), tls.client_key, "this key")
    if tls.insecure:
        why = "is true: another machine with a certificate of a trusted authority can pose as this one"
        reader.notes.warning((*path, "insecure"), why)
    for key, partner in (("client_cert", "client_key"), ("client_key", "client_cert")):
        if key in named and partner not in named:
            reader.notes.doubt((*path, partner), f"is missing, it belongs to {key}")
    return tls


def _mqtt(reader: Reader, mqtt: Mqtt, path: Path) -> Mqtt:
    keys = [key for key in ("password", "password_file", "password_env") if getattr(mqtt, key) is not None]
    if len(keys) > 1:
        reader.notes.problem((*path, keys[1]), f"is a second password beside {keys[0]}, leave one of them")
        return mqtt
    if mqtt.username is not None and len(mqtt.username.encode()) > _LONGEST_TEXT:
        reader.notes.problem((*path, "username"), f"is longer than MQTT carries, {_LONGEST_TEXT} bytes")
    if keys and mqtt.username is None:
        reader.notes.warning((*path, keys[0]), "is not sent: there is no username")
    password: str | None = mqtt.password
    if mqtt.password_env is not None:
        password = _variable(reader, mqtt.password_env, (*path, "password_env"))
    elif mqtt.password_file is not None:
        password = _contents(reader, mqtt.password_file, (*path, "password_file"))
        warn_if_readable(reader.notes, (*path, "password_file"), mqtt.password_file, "this password")
        if "\n" in (password or ""):  # a key, or another file: what is in it would be sent to the broker
            reader.notes.problem((*path, "password_file"), "holds several lines, a password is one")
    if password is None:
        return mqtt
    if len(password.encode()) > _LONGEST_TEXT:
        reader.notes.problem((*path, *keys), f"holds more than MQTT carries, {_LONGEST_TEXT} bytes")
    return replace(mqtt, password=Secret(password))


def _variable(reader: Reader, name: str, path: Path) -> str | None:
    if name not in reader.env:
        shown = f"the environment variable {name}" if _VARIABLE(name) else "it names an environment variable that"
        reader.notes.problem(path, f"{shown} is not set, set it before the start")
        return None
    reader.password_variables[name] = None
    return reader.env[name]


def _contents(reader: Reader, file: FilePath, path: Path) -> str | None:
    """Return the file's text without its final newline; if it cannot be read, note the problem and return None."""
    try:
        return text_of(read_for(reader.file, file)).rstrip("\n")
    except FileNotFoundError:
        # a password that was written instead of a file's name is not repeated
        shown = f"there is no file {file}" if path[-1] != "password_file" else f"there is no such file in {file.parent}"
        reader.notes.problem(path, shown)
    except NotTextError as error:
        reader.notes.problem(path, f"{file} {error}")
    except PebbleError as error:
        reader.notes.problem(path, f"cannot be read: {error}")
    except OSError as error:
        reader.notes.problem(path, f"{file} cannot be read: {error.strerror}")
    return None


#: By the class of a section, subclasses included. Extensions add their own.
CHECKS: tuple[Rule, ...] = (
    (Root, _root),
    (TransportSection, _transport),
    (MqttBridge, _bridge),
    (SerialBridge, _serial),
    (Tls, _tls),
    (Mqtt, _mqtt),
)
