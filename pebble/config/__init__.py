"""One robot's config: read from its JSON file, checked, completed, and from then on typed and unchangeable.

docs/configuration.md lists every key; configs/schema.json tells editors.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from pebble.config.checks import CHECKS
from pebble.config.inherit import inherit
from pebble.config.links import Mqtt as Mqtt
from pebble.config.links import RemoteLink as RemoteLink
from pebble.config.links import RemoteMqtt as RemoteMqtt
from pebble.config.links import Tls as Tls
from pebble.config.links import TransportSection as TransportSection
from pebble.config.reader import Reader
from pebble.config.text import decode, plain, read_text
from pebble.config.tree import Heartbeat as Heartbeat
from pebble.config.tree import Launcher as Launcher
from pebble.config.tree import MqttBridge as MqttBridge
from pebble.config.tree import Root
from pebble.config.tree import SerialBridge as SerialBridge
from pebble.config.tree import SerialBridges as SerialBridges
from pebble.config.tree import Services as Services
from pebble.config.tree import SystemControl as SystemControl
from pebble.config.types import Secret as Secret
from pebble.config.view import resolved as resolved
from pebble.errors import ConfigError
from pebble.identity import Identity


class Config(Root, frozen=True, kw_only=True):
    """A whole, valid config: the keys of the file as attributes of the same names, and what follows from them."""

    identity: Identity
    path: Path | None  # None: not from a file
    folder: Path  # where relative paths start
    warnings: tuple[str, ...]  # what the user should know, one line each
    run_folder: Path

    @property
    def base(self) -> str:
        """What all topics of this robot begin with, without a final slash."""
        return self.identity.base

    def run_dir(self) -> Path:
        """The folder of this robot's sockets and locks, absolute; not created here."""
        return self.run_folder

    def log_level_of(self, service: str) -> str:
        """How much a process logs: ``mqtt_bridge``, ``serial_mcu_bridge:imu``, or any other name for the root's."""
        name, _, instance = service.partition(":")
        section = getattr(self.services, name, None)
        if instance and isinstance(section, SerialBridges):
            section = section.instances.get(instance, section)
        return str(getattr(section, "log_level", self.log_level))

    def serial_instances(self) -> dict[str, SerialBridge]:
        """The enabled serial lines, one process each, by instance name; the service's own entry is ``""``."""
        own = self.services.serial_mcu_bridge
        lines: dict[str, SerialBridge] = {"": own, **own.instances}
        return {name: line for name, line in lines.items() if line.enabled and line.serial.port is not None}

    def media_programs(self) -> tuple[str, ...]:
        """What runs while operators want pictures or sound: programs of the launcher, by the services' names."""
        devices = self.services.av_daemon
        if not (self.services.mqtt_bridge.enabled and devices.enabled):
            return ()
        video = ("camera_publisher",) if devices.video.enabled else ()
        return (*video, *(("audio_publisher", "audio_receiver") if devices.audio.enabled else ()))

    def on_demand_programs(self) -> tuple[str, ...]:
        """All that the bridge may want: the media programs, and a streaming program that is none of ours."""
        own = self.services.video_stream
        stream = ("video_stream",) if own.enabled and own.command and self.services.mqtt_bridge.enabled else ()
        return (*self.media_programs(), *stream)


def load(path: Path | str, env: Mapping[str, str] = os.environ) -> Config:
    """Read a config file. Raises ConfigError that holds every problem found in it."""
    path = Path(path).absolute()
    return _config(decode(read_text(path), path.name), path, path.parent, env)


def parse(raw: dict[str, Any], *, folder: Path, env: Mapping[str, str]) -> Config:
    """The same from plain data. ``folder`` is where relative paths start, ``env`` the environment for passwords."""
    return _config(raw, None, folder.absolute(), env)


def _config(raw: Any, path: Path | None, folder: Path, env: Mapping[str, str]) -> Config:
    reader = Reader(folder, env, CHECKS)
    own = plain(raw, reader.notes)
    merged = inherit(own)
    root = reader.section(Root, merged)
    reader.notes.forget_inherited(own, merged)
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(map(str, reader.notes.problems))))
    identity = Identity(root.robot.system, root.robot.type, root.robot.id)
    return Config(
        **asdict(root),
        identity=identity,
        path=path,
        folder=folder,
        warnings=reader.notes.warning_lines(),
        run_folder=_run_folder(root, identity.base, env),
    )


def _run_folder(root: Root, base: str, env: Mapping[str, str]) -> Path:
    return root.transport.run_dir or default_run_folder(base, env)


def default_run_folder(base: str, env: Mapping[str, str]) -> Path:
    """Of the robot with this base topic, where its config names none.

    Short, because a unix socket's path ends at 108 bytes; one per robot, because a host may run two.
    """
    if by_systemd := env.get("RUNTIME_DIRECTORY"):
        return Path(by_systemd.split(":")[0])  # one per RuntimeDirectory= of the unit
    robot = f"{zlib.crc32(base.encode()):08x}"
    if by_login := env.get("XDG_RUNTIME_DIR"):
        return Path(by_login, "pebble", robot)
    return Path(env.get("TMPDIR", "/tmp"), f"pebble-{os.getuid()}", robot)  # noqa: S108 - 0700 and checked when made
