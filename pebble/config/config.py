"""The config of a robot: read from its JSON file, checked and completed; typed and unchangeable from then on."""

import hashlib
import os
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from msgspec import defstruct
from msgspec.structs import asdict, fields, replace

from pebble import extension as extensions
from pebble.config import problems
from pebble.config.home import in_home
from pebble.config.masking import holds_secret, masked, values_of
from pebble.config.problems import Note, Notes
from pebble.config.raw import Pairs, decode, plain, read_text, with_instances, without
from pebble.config.reader import Check, Reader, Rule
from pebble.config.rules.between_keys import CHECKS
from pebble.config.rules.exposure import warn_if_readable
from pebble.config.tree import Root, SerialBridge, Services, tree_of
from pebble.config.types import Section
from pebble.config.visible import is_text, shown
from pebble.contract.identity import Identity
from pebble.contract.serial_protocols import OF_CORE, SERIAL_PROTOCOLS
from pebble.errors import ConfigError
from pebble.extension import Extension, Missing
from pebble.ownership import read_plain

#: In the run directory: the process id of the robot's newest launcher, and on a second line the robot's base topic.
LAUNCHER_LOCK = "launcher.lock"
RUN_DIR_OF_UNIT = Path("/run/pebble")  # of our unit; a tool that is started from a shell does not see its environment
_LONGEST_NAME = 150  # bytes; file systems allow 255

S = TypeVar("S", bound=Section)


class Config(Root, frozen=True, kw_only=True):
    """A complete, valid config: the keys of the file as attributes of the same names, and values derived from them."""

    identity: Identity
    path: Path | None  # None: not from a file
    folder: Path  # where relative paths start
    warnings: tuple[str, ...]  # one line each
    run_folder: Path
    state_folder: Path
    password_variables: tuple[str, ...]  # environment variables from which passwords were read
    installed: tuple[Extension, ...]
    missing: tuple[Missing, ...]
    motor_owners: tuple[str, ...] = ()  # of the whole robot, also in the view of one serial line

    @property
    def base(self) -> str:
        """The first three levels of all topics of this robot, without a final slash."""
        return self.identity.base

    def section(self, kind: type[S]) -> S:
        """Return the section of class ``kind``, which an extension adds; its defaults without that extension."""
        return next(values_of(self, kind), kind())

    def run_dir(self) -> Path:
        """Return the folder of this robot's sockets and locks, absolute; not created here."""
        return self.run_folder

    def state_dir(self) -> Path:
        """Return the folder for files that must survive a power cut, absolute; not created here."""
        return self.state_folder

    def state_file(self, name: str) -> Path:
        """Return the path of a file in the state directory, which several robots may share."""
        return self.state_folder / f"{name}-{file_name(self.base)}.json"

    @staticmethod
    def motor_owner(instance: str) -> str:
        """Return the name of a serial line's motor owner, as in ``outgoing/estop/{owner}``."""
        return instance or "serial"

    def serial_instances(self) -> dict[str, SerialBridge]:
        """Return the enabled serial lines, one process each, by instance name; ``""`` is the section itself."""
        section = self.services.serial_mcu_bridge
        lines: dict[str, SerialBridge] = {"": section, **section.instances}
        protocols = {*OF_CORE}.union(*(extension.protocols for extension in self.installed))
        return {
            name: line
            for name, line in lines.items()
            if line.enabled and line.serial.port is not None and line.protocol in protocols
        }

    def hall_memory(self, line: SerialBridge) -> str | None:
        """Return the name of the shared memory for this line's hall samples, or None."""
        ring = line.odometry_shm
        if ring is None or not ring.enabled:
            return None
        return ring.name or f"{self.base.replace('/', '_')}_odometry_raw"

    def motor_lines(self) -> dict[str, SerialBridge]:
        """Return the enabled serial lines that drive motors."""
        lines = self.serial_instances().items()
        return {name: line for name, line in lines if SERIAL_PROTOCOLS[line.protocol].drives}

    def on_demand_programs(self) -> tuple[str, ...]:
        """Return the programs that the bridge may request: they run while operators want their pictures or sound."""
        return tuple(program.name for program in extensions.programs_of(self.installed, self) if program.on_demand)


def load(
    path: Path | str, env: Mapping[str, str] = os.environ, *, lenient: bool = False, core_only: bool = False
) -> Config:
    """Read a config file. Raises ConfigError with every problem in it.

    ``lenient``: an extension that this machine lacks is a warning. ``core_only``: no extension is used.
    """
    path = Path(path).absolute()
    raw = decode(read_text(path), path.name)
    if isinstance(raw, Pairs) and "robot" not in (keys := dict(raw)) and ("robots" in keys or "tags" in keys):
        raise ConfigError(f"{path.name}: this is a world file, for pebble sim world; name the config file of a robot")
    return _config(raw, path, path.parent, env, lenient=lenient, core_only=core_only)


_handed_over: Config | None = None


def hand_over(config: Config) -> None:
    """Set the config of this process. The launcher does so before it forks its children: they have it, too."""
    global _handed_over
    _handed_over = config


def config_of_process(path: Path | str) -> Config:
    """Return the config that the launcher read from ``path`` when the robot started; without one, read the file."""
    if _handed_over is not None and _handed_over.path == Path(path).absolute():
        return _handed_over
    return load(path)


def parse(raw: dict[str, Any], *, folder: Path, env: Mapping[str, str]) -> Config:
    """Return a config from plain data. Relative paths start at ``folder``; ``env`` has the passwords."""
    return _config(raw, None, folder.absolute(), env)


def _config(
    raw: Any,
    path: Path | None,
    folder: Path,
    env: Mapping[str, str],
    *,
    lenient: bool = False,
    core_only: bool = False,
) -> Config:
    """Read, check and complete a config; the arguments are those of :func:`load` and :func:`parse`."""
    notes = Notes()
    written = plain(raw, notes)
    available, lacking = _extensions(written, folder)
    installed, missing = ((), ()) if core_only else (available, lacking)  # those that count here
    about_missing = [Note(tuple(extension.key.split(".", 1)), extension.reason) for extension in missing]
    (notes.warnings if lenient else notes.problems).extend(about_missing)
    file_class, config_class, rules = _classes(installed)
    reader = Reader(folder, env, rules, notes, file=path, other_forms=True)
    merged = with_instances(written)
    ignored_keys = extensions.keys_of_missing(installed)  # of our other extensions: file_class lacks these keys
    if core_only:
        ignored_keys += [key for extension in available for key in extension.sections]
    root = reader.section(file_class, without(merged, ignored_keys))
    notes.forget_inherited(written, merged)
    if path is not None and holds_secret(written):
        warn_if_readable(notes, (), path, "it, and there is a password in it")
    if notes.problems:
        # Missing extensions first, even those that are only warnings: unknown sections may be theirs. None comes twice.
        raise ConfigError(list(dict.fromkeys(map(str, (*about_missing, *notes.problems)))))
    identity = Identity(root.robot.system, root.robot.type, root.robot.id)
    config: Config = config_class(
        **asdict(root),
        installed=installed,
        missing=missing,
        identity=identity,
        path=path,
        folder=folder,
        warnings=notes.warning_lines(),
        run_folder=root.transport.run_dir or default_run_folder(identity.base, env),
        state_folder=root.transport.state_dir or default_state_folder(identity.base, env),
        password_variables=tuple(reader.password_variables),
    )
    if lenient:
        config = _without_broken(config)
    if not is_text(str(config.run_dir())):
        why = "is no UTF-8, and sockets below it have to be: set it to another folder"
        raise ConfigError(f"transport.run_dir: {shown(str(config.run_dir()))}: {why}")
    return replace(config, motor_owners=_motor_owners(config))


def _motor_owners(config: Config) -> tuple[str, ...]:
    """Return the names of all motor owners: serial lines and extensions. Raises ConfigError if two have one name."""
    owners = (*map(config.motor_owner, config.motor_lines()), *extensions.motors_of(config.installed, config))
    if len(owners) > len(set(owners)):
        raise ConfigError("extensions: two motor owners have one name; serial lines are called as their instances")
    return owners


def _extensions(written: Any, folder: Path) -> tuple[tuple[Extension, ...], tuple[Missing, ...]]:
    """Return the extensions of this config, ours and those that the file lists; and those of either that are missing.

    Also registers the serial protocols of those that the file lists.
    """
    listed = extensions.value_at(written, "extensions")
    entries = listed if isinstance(listed, dict) else {}
    drives = {name: extensions.value_at(entry, "drives") is True for name, entry in entries.items()}
    named, missing = extensions.named(drives, folder, Section)
    installed = (*extensions.ours(), *named)
    # What the core has is declared as an extension too, so that no other may add a section or protocol of its names.
    taken = [*dir(Config), *(f"services.{name}" for name in dir(Services))]  # of keys, and of methods too
    protocols = {name: SERIAL_PROTOCOLS[name] for name in OF_CORE}
    core = Extension(name="core", package="Pebble", sections=dict.fromkeys(taken, ""), protocols=protocols)
    extensions.refuse_claims(core, installed)
    for extension in named:
        SERIAL_PROTOCOLS.update(extension.protocols)
    return installed, (*missing, *extensions.lacking(written))


def _without_broken(config: Config) -> Config:
    """Return the config without extensions whose list of programs cannot be made, so that the robot starts."""
    for extension in config.installed:
        try:
            extensions.programs_of([extension], config)
        except ConfigError as error:
            key, drives = f"extensions.{extension.name}", bool(extension.motors)
            missing = (*config.missing, Missing(extension.name, key, str(error), drives))
            installed = tuple(other for other in config.installed if other is not extension)
            config = replace(config, installed=installed, missing=missing, warnings=(*config.warnings, str(error)))
    return config


@cache
def _classes(installed: tuple[Extension, ...]) -> tuple[type[Root], Any, tuple[Rule, ...]]:
    """Return the class of a config file, the one of a Config, both with the sections of extensions, and the rules."""
    sections: dict[str, type[Section]] = {}
    rules: list[Rule] = []
    for extension in installed:
        sections |= {key: extensions.part(place) for key, place in extension.sections.items()}
        if extension.rules:
            rules += [(section, _guarded(extension, rule)) for section, rule in extensions.part(extension.rules)]
    file_class: type[Root] = tree_of(sections)
    keys = [field for field in fields(file_class) if field.name not in Root.__struct_fields__]
    added = [(field.name, field.type, field.default) for field in keys]
    namespace = {"__doc__": Config.__doc__, "__module__": __name__}
    config_class = defstruct("Config", added, bases=(Config,), namespace=namespace, frozen=True, kw_only=True)
    return file_class, config_class, (*CHECKS, *rules)


def _guarded(owner: Extension, rule: Check) -> Check:
    """Return a rule whose exceptions become problems of the config; a rule of our own extensions stays as it is."""
    if owner in extensions.ours():
        return rule

    def check(reader: Reader, section: Any, path: problems.Path) -> Any:
        try:
            checked = rule(reader, section, path)
        except Exception as error:  # noqa: BLE001 - whatever foreign code raises
            problem = f"failed: {type(error).__name__}: {error}"
        else:
            if isinstance(checked, type(section)):
                return checked
            problem = f"returned no {type(section).__name__}"
        reader.notes.problem(path, f"a rule of {owner.package} {problem}")
        return section

    return check


def full_tree() -> type[Root]:
    """Return the class of a file with our extensions only, for the schema and the table of keys."""
    file_class, _, _ = _classes(extensions.ours())
    return file_class


def default_run_folder(base: str, env: Mapping[str, str]) -> Path:
    """Return the run directory of the robot with this base topic, if its config names none.

    Short, because a unix socket's path ends at 108 bytes; one per robot, because a host may run two.
    """
    if by_systemd := env.get("RUNTIME_DIRECTORY"):
        return Path(by_systemd.split(":")[0])  # one per RuntimeDirectory= of the unit
    if _is_run_from(RUN_DIR_OF_UNIT, base):
        return RUN_DIR_OF_UNIT  # a tool in a shell finds the robot that our unit runs
    robot = f"{zlib.crc32(base.encode()):08x}"
    if (by_login := env.get("XDG_RUNTIME_DIR")) and is_text(by_login):
        return Path(by_login, "pebble", robot)
    temporary = next(name for name in (env.get("TMPDIR"), "/tmp") if name and is_text(name))  # noqa: S108
    user = os.getuid() if hasattr(os, "getuid") else 0  # Windows has none, and a temporary folder for each user
    return Path(temporary, f"pebble-{user}", robot)  # 0700, and checked when made


def _is_run_from(folder: Path, base: str) -> bool:
    """True if this run directory can be read, and its newest launcher was that of the robot with this base topic."""
    try:
        lines = read_plain(folder / LAUNCHER_LOCK).decode(errors="replace").splitlines()
    except OSError:
        return False
    return len(lines) > 1 and lines[1] == base


def default_state_folder(base: str, env: Mapping[str, str]) -> Path:
    """Return the state directory of the robot with this base topic, if its config names none; one per robot."""
    robot = file_name(base)
    if by_systemd := env.get("STATE_DIRECTORY"):
        return Path(by_systemd.split(":")[0], robot)
    return Path(env.get("XDG_STATE_HOME") or in_home("~/.local/state"), "pebble", robot)


def file_name(base: str) -> str:
    """Return a file name for one robot: its base topic, or a digest if that is too long for a file system."""
    name = base.replace("/", "+")  # no level of a topic contains a +
    return name if len(os.fsencode(name)) <= _LONGEST_NAME else hashlib.sha256(os.fsencode(base)).hexdigest()


def resolved(config: Config) -> dict[str, Any]:
    """Return the whole config as plain data: the file's keys, every default and inherited value, and ``derived``.

    Keys that are not set and have no default are left out; secrets and the values of variables read ``***``.
    """
    not_in_file = {*Config.__struct_fields__} - {*Root.__struct_fields__}  # extensions' keys are in neither, and stay
    names = [name for name in config.__struct_fields__ if name not in not_in_file and name != "schema_"]
    keys = {name: masked(getattr(config, name), name) for name in names}
    return keys | {
        "derived": {
            "base": config.base,
            "run_dir": str(config.run_dir()),
            "state_dir": str(config.state_dir()),
            "serial_instances": list(config.serial_instances()),
        }
    }
