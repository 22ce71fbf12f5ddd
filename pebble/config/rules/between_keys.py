"""Checks between the keys of a section, and of what only the machine knows: files and passwords."""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path as FilePath
from typing import Any

from msgspec.structs import replace

from pebble.config.hosts import HostError, check_web_url
from pebble.config.media import AvDaemon, VideoStream
from pebble.config.problems import Path
from pebble.config.reader import Check, Reader
from pebble.config.rules.doors import check_doors, check_lan
from pebble.config.rules.exposure import warn_if_readable, warn_of_known_id, warn_of_logins_in_clear
from pebble.config.rules.shared_topics import shared_topics
from pebble.config.secret_text import without_login
from pebble.config.text_files import NotTextError, read_text
from pebble.config.transport import Mqtt, RemoteMqtt, Tls, TransportSection
from pebble.config.tree import MqttBridge, Root, SerialBridge, Services
from pebble.config.types import Secret
from pebble.contract import DRIVE, OUTGOING, channel_of, is_reserved
from pebble.contract.identity import GATEWAYS, SERVERS
from pebble.extensions.page.config import WebInterface, WebTls
from pebble.services.neighbours.config import Neighbours

MOST_NEIGHBOURS, MOST_METRICS = 16, 32  # of one robot; metrics of one neighbour
_TLS = ("tls/", "quic/")  # endpoints of Zenoh that are encrypted
_LONGEST_TEXT = 65535  # bytes of a user name or password (MQTT 3.1.1, section 1.5.3)
_VARIABLE = re.compile("[A-Z_][A-Z0-9_]*").fullmatch  # as they are usually written; else it may be a password
_INSTANCE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,32}").fullmatch  # it becomes part of a process's name and client id


def _root(reader: Reader, root: Root, _path: Path) -> Root:
    kind, platform = root.transport.kind, root.robot.platform
    if root.transport.mqtt_mirror is not None and kind != "zenoh":
        reader.notes.doubt(
            ("transport", "mqtt_mirror"), f'only a Zenoh robot has a mirror and kind is "{kind}": leave it out'
        )
    if root.robot.type in (SERVERS, GATEWAYS):
        reader.notes.problem(("robot", "type"), f'must not be "{root.robot.type}": those are no robots')
    if platform != "linux" and kind != "mqtt":
        reader.notes.doubt(("transport", "kind"), f'must be "mqtt" where robot.platform is "{platform}"')
    if not reader.notes.problems:
        for path, other in shared_topics(root):
            reader.notes.problem(path, f"is also the topic of {other.suffix}, choose another")
        warn_of_logins_in_clear(reader.notes, root)
        warn_of_known_id(reader.notes, root)
    check_doors(reader.notes, root)
    check_lan(reader.notes, root)
    return root


def _transport(reader: Reader, transport: TransportSection, path: Path) -> TransportSection:
    """Who may connect to a Zenoh robot from other machines is decided by certificates alone."""
    encrypted = next((one for one in transport.listen if one.startswith(_TLS)), None)
    if transport.allowed_names is not None and not any(
        one.startswith(_TLS) for one in (*transport.listen, *transport.connect)
    ):
        reader.notes.warning((*path, "allowed_names"), "has no effect: no tls/ or quic/ endpoint is listed")
    if transport.allowed_names is not None and transport.access is not None:
        reader.notes.problem((*path, "allowed_names"), "must be left out: access says what each name may do")
    if transport.kind != "zenoh" or encrypted is None:
        return transport
    if not transport.tls.enabled:
        reader.notes.doubt((*path, "tls", "enabled"), f"must be true, {encrypted} needs certificates")
    elif transport.tls.ca_cert is None:
        reader.notes.doubt(
            (*path, "tls", "ca_cert"),
            f"is missing: without it anybody may connect to {encrypted}; "
            "write the authority that signs the certificates of those who may",
        )
    return transport


def _services(reader: Reader, services: Services, path: Path) -> Services:
    if services.ros1_bridge.get("enabled"):
        reader.notes.warning(
            (*path, "ros1_bridge"),
            "is enabled, but arrives in a later release; skipped, and a stop sends zeros to one that runs",
        )
    if services.video_stream.enabled and not services.video_stream.command:
        reader.notes.doubt((*path, "video_stream", "command"), "is missing, write the program that streams the video")
    if services.soundboard_handler.enabled and not services.soundboard_handler.playback.player_command:
        reader.notes.doubt((*path, "soundboard_handler", "playback", "player_command"), "is missing, write aplay")
    return services


def _av_daemon(reader: Reader, devices: AvDaemon, path: Path) -> AvDaemon:
    """The sockets for programs of the original. Without a folder for them the robot runs, and they wait."""
    sockets = devices.sockets()
    for section, file in sockets.items():
        if not file.parent.is_dir():
            text = f"there is no folder {file.parent}: until there is, no program finds this socket"
            reader.notes.warning((*path, section, "socket_path"), text)
    if len(sockets) > len(set(sockets.values())):
        reader.notes.problem((*path, "audio", "socket_path"), "is also that of video, write another")
    return devices


def _video_stream(reader: Reader, stream: VideoStream, path: Path) -> VideoStream:
    """Every operator receives the address: a login in it would be no secret."""
    if stream.webrtc_url is None:
        return stream
    public = without_login(stream.webrtc_url)
    if public != stream.webrtc_url:
        reader.notes.warning((*path, "webrtc_url"), "its login is left out, because the address is published")
    try:
        check_web_url(public)
    except HostError as error:
        reader.notes.warning((*path, "webrtc_url"), f"no page can show it: {error}")
    return replace(stream, webrtc_url=public)


def _neighbours(reader: Reader, section: Neighbours, path: Path) -> Neighbours:
    problem, lan = reader.notes.problem, section.lan
    if section.enabled and not lan.connect:
        reader.notes.doubt((*path, "lan", "connect"), 'is missing, write where the hub listens: ["tls/hub.lab:7447"]')
    if lan.account and (not lan.tls.enabled or lan.tls.client_cert is None):
        problem((*path, "lan", "account"), "needs tls.client_cert, in which it is the name")
    for key, names in (("commanded", section.commanded), ("listens", section.listens)):
        if len(names) > MOST_NEIGHBOURS:
            problem((*path, key), f"has {len(names)} robots: {MOST_NEIGHBOURS} are the most")
    for name, granted in section.commanded.items():
        if any(metric != DRIVE.metric for metric in granted):
            problem((*path, "commanded", name), f'must be ["{DRIVE.metric}"]: nothing else can be granted')
    named = [(("shares",), section.shares), *((("listens", name), found) for name, found in section.listens.items())]
    for place, metrics in named:
        if len(metrics) > MOST_METRICS:
            problem((*path, *place), f"has {len(metrics)} metrics: {MOST_METRICS} are the most")
        for metric in metrics:
            channel = channel_of(f"{OUTGOING}/{metric}")
            if is_reserved(metric) or (channel is not None and not (channel.remote and channel.bridged)):
                problem((*path, *place), f"{metric} cannot be shared: no pictures or sound, nor who stops and drives")
    return section


def _bridge(reader: Reader, bridge: MqttBridge, path: Path) -> MqttBridge:
    notes, remote, link = reader.notes, bridge.remote, bridge.link
    if link.kbit is not None and link.profile == "wide":
        notes.problem(
            (*path, "link", "kbit"), 'has no effect at profile "wide": write "thin" or "auto", or leave it out'
        )
    if link.profile == "auto" and remote is not None and remote.kind != "mqtt":
        text = f'cannot be "auto": only MQTT connections are measured, and remote.kind is "{remote.kind}"; write "thin"'
        notes.problem((*path, "link", "profile"), text)
    if remote is not None and remote.kind != "mqtt":
        if bridge.remote_mqtt.host:
            notes.warning((*path, "remote_mqtt"), f'not used: remote.kind is "{remote.kind}"')
        if remote.kind == "zenoh" and not remote.connect:
            notes.doubt((*path, "remote", "connect"), "is missing, write the endpoint of the operators' hub")
        if remote.kind == "zenoh" and remote.listen:
            notes.problem((*path, "remote", "listen"), "an uplink only connects: leave it out")
        if remote.account and (not remote.tls.enabled or remote.tls.client_cert is None):
            notes.problem((*path, "remote", "account"), "needs tls.client_cert, in which it is the name")
    elif bridge.enabled and not bridge.remote_mqtt.host:
        notes.doubt((*path, "remote_mqtt", "host"), "is missing, write the name of the remote broker")
    return bridge


def _serial(reader: Reader, serial: SerialBridge, path: Path) -> SerialBridge:
    if "instances" in path:
        if serial.instances:
            reader.notes.problem((*path, "instances"), "must be left out: an instance has none")
        return serial
    lines = {(*path, "instances", name): line for name, line in serial.instances.items()}
    if serial.serial.port is not None or not any(line.enabled for line in lines.values()):
        lines = {path: serial, **lines}
    ports: dict[str, str] = {}
    for place, line in lines.items():
        if line.enabled:
            _serial_line(reader, line, place, ports)
    for name in serial.instances:
        if not _INSTANCE_NAME(name):
            reader.notes.problem((*path, "instances", name), "must be named with 1 to 32 of A-Z a-z 0-9 _ . -")
    if path in lines and "serial" in serial.instances:
        reader.notes.problem((*path, "instances", "serial"), "is what the line of this section is called, rename it")
    return serial


def _serial_line(reader: Reader, line: SerialBridge, path: Path, ports: dict[str, str]) -> None:
    name, port = str(path[-1]), line.serial.port
    if port is None:
        reader.notes.doubt((*path, "serial", "port"), "is missing, write the device: ls /dev/serial/by-id/*")
    elif port in ports:
        reader.notes.problem(path, f"shares {port} with {ports[port]}, write another serial.port")
    else:
        ports[port] = name


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
        reader.notes.warning(
            (*path, "insecure"),
            "is true: another machine with a certificate of a trusted authority can pose as this one",
        )
    for key, other in (("client_cert", "client_key"), ("client_key", "client_cert")):
        if key in named and other not in named:
            reader.notes.doubt((*path, other), f"is missing, it belongs to {key}")
    return tls


def _web(reader: Reader, web: WebInterface, path: Path) -> WebInterface:
    """A mistake here must not keep the robot from starting: without a page it still drives."""
    if not web.local and web.tls.certificate is None and not web.plain_http:
        reader.notes.warning(
            (*path, "host"),
            f"other machines reach {web.host}, so the page starts only with a certificate and a user: run "
            f"`pebble cert init` and `pebble web user add`, write web_interface.tls; or leave out host",
        )
    if not web.mqtt.host and web.mqtt != RemoteMqtt():
        reader.notes.warning((*path, "mqtt"), "not used: it has no host, so the page connects to the robot's broker")
    if web.plain_http and web.tls.certificate is not None:
        reader.notes.warning((*path, "plain_http"), "has no effect: there is a certificate, so the page is https")
    return web


def _web_tls(reader: Reader, tls: WebTls, path: Path) -> WebTls:
    for key, other in (("certificate", "key"), ("key", "certificate")):
        if getattr(tls, key) is not None and getattr(tls, other) is None:
            reader.notes.doubt((*path, other), f"is missing, it belongs to {key}")
    for key in ("certificate", "key", "ca"):
        file = getattr(tls, key)
        if file is not None and not file.is_file():
            reader.notes.warning((*path, key), f"there is no file {file}; run `pebble cert init`")
    if tls.key is not None:
        warn_if_readable(reader.notes, (*path, "key"), tls.key, "this key")
    return tls


def _mqtt(reader: Reader, mqtt: Mqtt, path: Path) -> Mqtt:
    given = [key for key in ("password", "password_file", "password_env") if getattr(mqtt, key) is not None]
    if len(given) > 1:
        reader.notes.problem((*path, given[1]), f"is a second password beside {given[0]}, leave one of them")
        return mqtt
    if mqtt.username is not None and len(mqtt.username.encode()) > _LONGEST_TEXT:
        reader.notes.problem((*path, "username"), f"is longer than MQTT carries, {_LONGEST_TEXT} bytes")
    if given and mqtt.username is None:
        reader.notes.warning((*path, given[0]), "is not sent: there is no username")
    password: str | None = mqtt.password
    if mqtt.password_env is not None:
        password = _variable(reader, mqtt.password_env, (*path, "password_env"))
    elif mqtt.password_file is not None:
        password = _contents(reader, mqtt.password_file, (*path, "password_file"))
        warn_if_readable(reader.notes, (*path, "password_file"), mqtt.password_file, "this password")
    if password is None:
        return mqtt
    if len(password.encode()) > _LONGEST_TEXT:
        reader.notes.problem((*path, *given), f"holds more than MQTT carries, {_LONGEST_TEXT} bytes")
    return replace(mqtt, password=Secret(password))


def _variable(reader: Reader, name: str, path: Path) -> str | None:
    if name not in reader.env:
        shown = f"the environment variable {name}" if _VARIABLE(name) else "it names an environment variable that"
        reader.notes.problem(path, f"{shown} is not set, set it before the start")
        return None
    reader.password_variables[name] = None
    return reader.env[name]


def _contents(reader: Reader, file: FilePath, path: Path) -> str | None:
    """The file's text without its final newline; noted and None when it cannot be read."""
    try:
        return read_text(file).rstrip("\n")
    except FileNotFoundError:
        # a password that was written instead of a file's name is not repeated
        shown = f"there is no file {file}" if path[-1] != "password_file" else f"there is no such file in {file.parent}"
        reader.notes.problem(path, shown)
    except NotTextError as error:
        reader.notes.problem(path, f"{file} {error}")
    except OSError as error:
        reader.notes.problem(path, f"{file} cannot be read: {os.strerror(error.errno or 0)}")
    return None


def _table(*rows: tuple[type[Any], Callable[[Reader, Any, Path], Any]]) -> Mapping[type[Any], Check]:
    return dict(rows)


#: By the class of a section, subclasses included.
CHECKS = _table(
    (Root, _root),
    (TransportSection, _transport),
    (Services, _services),
    (AvDaemon, _av_daemon),
    (VideoStream, _video_stream),
    (MqttBridge, _bridge),
    (Neighbours, _neighbours),
    (SerialBridge, _serial),
    (Tls, _tls),
    (Mqtt, _mqtt),
    (WebTls, _web_tls),
    (WebInterface, _web),
)
