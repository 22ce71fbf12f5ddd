"""A whole config: read from its JSON file, checked, completed, and from then on typed and unchangeable."""

import hashlib
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import asdict, replace

from pebble.config.home import in_home
from pebble.config.masking import holds_secret, masked
from pebble.config.raw import Pairs, decode, plain, read_text, with_instances
from pebble.config.reader import Reader
from pebble.config.rules.between_keys import CHECKS
from pebble.config.rules.exposure import warn_if_readable
from pebble.config.tree import Root, SerialBridge
from pebble.config.types import Topic
from pebble.contract import DRIVE
from pebble.contract.identity import Identity
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import ConfigError

#: In the run directory: the process id of the robot's newest launcher, and on a second line the robot's base topic.
LAUNCHER_LOCK = "launcher.lock"
RUN_DIR_OF_UNIT = Path("/run/pebble")  # of our unit; a tool that is started from a shell does not see its environment
_LONGEST_NAME = 150  # bytes; file systems allow 255


class Config(Root, frozen=True, kw_only=True):
    """A complete, valid config: the keys of the file as attributes of the same names, and values derived from them."""

    identity: Identity
    path: Path | None  # None: not from a file
    folder: Path  # where relative paths start
    warnings: tuple[str, ...]  # one line each
    run_folder: Path
    state_folder: Path
    password_variables: tuple[str, ...]  # of the environment: those that passwords were read from
    motor_owners: tuple[str, ...] = ()  # of the whole robot, also in the view of one serial line

    @property
    def base(self) -> str:
        """What all topics of this robot begin with, without a final slash."""
        return self.identity.base

    def run_dir(self) -> Path:
        """The folder of this robot's sockets and locks, absolute; not created here."""
        return self.run_folder

    def state_dir(self) -> Path:
        """The folder of what must survive a power cut, absolute; not created here."""
        return self.state_folder

    def state_file(self, name: str) -> Path:
        """A file in the state directory, which several robots may share."""
        return self.state_folder / f"{name}-{file_name(self.base)}.json"

    @staticmethod
    def motor_owner(instance: str) -> str:
        """What the motor owner of a serial line is called in ``outgoing/estop/{owner}``."""
        return instance or "serial"

    def serial_instances(self) -> dict[str, SerialBridge]:
        """The enabled serial lines, one process each, by instance name; the service's own entry is ``""``."""
        own = self.services.serial_mcu_bridge
        lines: dict[str, SerialBridge] = {"": own, **own.instances}
        return {name: line for name, line in lines.items() if line.enabled and line.serial.port is not None}

    def hall_memory(self, line: SerialBridge) -> str | None:
        """The name of the shared memory that gets this line's hall samples; None: there is none."""
        ring = line.odometry_shm
        if ring is None or not ring.enabled:
            return None
        return ring.name or f"{self.base.replace('/', '_')}_odometry_raw"

    def motor_lines(self) -> dict[str, SerialBridge]:
        """Those of the enabled serial lines that drive motors."""
        lines = self.serial_instances().items()
        return {name: line for name, line in lines if SERIAL_PROTOCOLS[line.protocol].drives}

    @property
    def zeros(self) -> tuple[str, ...]:
        """The drive topics of what moves the robot and cannot latch: to it a stop is a zero."""
        ros = self.services.ros1_bridge
        if not ros.get("enabled") or not _object(ros, "drive").get("enabled", True):
            return ()
        try:
            return (msgspec.convert(_object(ros, "topics").get("drive_values"), Topic),)
        except msgspec.ValidationError:  # it names none, or one that no message may have
            return (DRIVE.topic(self.base),)

    def media_programs(self) -> tuple[str, ...]:
        """The on-demand programs for pictures and sound, by the services' names."""
        devices = self.services.av_daemon
        if not (self.services.mqtt_bridge.enabled and devices.enabled):
            return ()
        video = ("camera_publisher",) if devices.video.enabled else ()
        return (*video, *(("audio_publisher", "audio_receiver") if devices.audio.enabled else ()))

    def on_demand_programs(self) -> tuple[str, ...]:
        """All programs that the bridge may request: the media programs, and a third party's streaming program."""
        own = self.services.video_stream
        stream = ("video_stream",) if own.enabled and own.command and self.services.mqtt_bridge.enabled else ()
        return (*self.media_programs(), *stream)


def load(path: Path | str, env: Mapping[str, str] = os.environ) -> Config:
    """Read a config file. Raises ConfigError with every problem in it."""
    path = Path(path).absolute()
    raw = decode(read_text(path), path.name)
    if isinstance(raw, Pairs) and (keys := dict(raw).keys()) & {"robots", "tags"} and "robot" not in keys:
        raise ConfigError(f"{path.name}: this is a world file, for pebble sim world; name the config file of a robot")
    return _config(raw, path, path.parent, env)


_handed_over: Config | None = None


def hand_over(config: Config) -> None:
    """Make ``config`` that of this process: the launcher does so in its children, which are forks of it."""
    global _handed_over
    _handed_over = config


def config_of_process(path: Path | str) -> Config:
    """The config that the launcher read from ``path`` when the robot started; without a launcher, as :func:`load`."""
    if _handed_over is not None and _handed_over.path == Path(path).absolute():
        return _handed_over
    return load(path)


def parse(raw: dict[str, Any], *, folder: Path, env: Mapping[str, str]) -> Config:
    """The same from plain data. ``folder`` is where relative paths start, ``env`` the environment for passwords."""
    return _config(raw, None, folder.absolute(), env)


def _config(raw: Any, path: Path | None, folder: Path, env: Mapping[str, str]) -> Config:
    reader = Reader(folder, env, CHECKS)
    own = plain(raw, reader.notes)
    merged = with_instances(own)
    root = reader.section(Root, merged)
    reader.notes.forget_inherited(own, merged)
    if path is not None and holds_secret(own):
        warn_if_readable(reader.notes, (), path, "it, and there is a password in it")
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(map(str, reader.notes.problems))))
    identity = Identity(root.robot.system, root.robot.type, root.robot.id)
    config = Config(
        **asdict(root),
        identity=identity,
        path=path,
        folder=folder,
        warnings=reader.notes.warning_lines(),
        run_folder=root.transport.run_dir or default_run_folder(identity.base, env),
        state_folder=root.transport.state_dir or default_state_folder(identity.base, env),
        password_variables=tuple(reader.password_variables),
    )
    return replace(config, motor_owners=tuple(map(config.motor_owner, config.motor_lines())))


def default_run_folder(base: str, env: Mapping[str, str]) -> Path:
    """The run directory of the robot with this base topic, if its config names none.

    Short, because a unix socket's path ends at 108 bytes; one per robot, because a host may run two.
    """
    if by_systemd := env.get("RUNTIME_DIRECTORY"):
        return Path(by_systemd.split(":")[0])  # one per RuntimeDirectory= of the unit
    if _is_run_from(RUN_DIR_OF_UNIT, base):
        return RUN_DIR_OF_UNIT
    robot = f"{zlib.crc32(base.encode()):08x}"
    if by_login := env.get("XDG_RUNTIME_DIR"):
        return Path(by_login, "pebble", robot)
    return Path(env.get("TMPDIR", "/tmp"), f"pebble-{_user_id()}", robot)  # noqa: S108 - 0700 and checked when made


def _is_run_from(folder: Path, base: str) -> bool:
    """Whether the newest launcher in this run directory, if we may read it, was that of this robot."""
    try:
        return (folder / LAUNCHER_LOCK).read_text(errors="replace", encoding="utf-8").splitlines()[1:2] == [base]
    except OSError:
        return False


def _user_id() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0  # Windows has none, and a temporary folder for each user


def default_state_folder(base: str, env: Mapping[str, str]) -> Path:
    """The state directory of the robot with this base topic, if its config names none; one per robot."""
    robot = file_name(base)
    if by_systemd := env.get("STATE_DIRECTORY"):
        return Path(by_systemd.split(":")[0], robot)
    return Path(env.get("XDG_STATE_HOME") or in_home("~/.local/state"), "pebble", robot)


def file_name(base: str) -> str:
    """A name for one robot's files: its base, or a digest of it where a file system would refuse the name."""
    name = base.replace("/", "+")  # which no level of a topic contains
    return name if len(name.encode()) <= _LONGEST_NAME else hashlib.sha256(base.encode()).hexdigest()


def resolved(config: Config) -> dict[str, Any]:
    """The keys of the file with every default and inherited value, and under ``derived`` what is computed from them.

    JSON can write all of it. Keys that are not set and have no default are left out; secrets and the values of
    variables read ``***``.
    """
    own = {
        name: masked(getattr(config, name), name)
        for name in ("log_level", "robot", "local_mqtt", "transport", "security", "services", "web_interface")
    }
    return own | {
        "derived": {
            "base": config.base,
            "run_dir": str(config.run_dir()),
            "state_dir": str(config.state_dir()),
            "serial_instances": list(config.serial_instances()),
        }
    }


def _object(section: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """The object at ``key`` of a section that is not checked; empty where something else is."""
    value = section.get(key)
    return value if isinstance(value, dict) else {}
