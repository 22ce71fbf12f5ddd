"""Extensions: optional parts of a robot, from us, from packages of others, or from a file of the robot's owner.

An extension is one object, ``EXTENSION``, that a package or a file declares. It names its parts as ``module:name``, and
they are imported where they are used: a robot that records nothing imports nothing of the recorder.
docs/my-first-extension.md shows an example.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import IntEnum
from functools import cache, reduce
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from pebble.contract.identity import LEVEL, LEVEL_RULE
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS, SerialProtocol
from pebble.errors import ConfigError, PebbleError
from pebble.ownership import owner_of

log = logging.getLogger(__name__)

T = TypeVar("T")

#: The group of entry points by which a package offers an extension.
ENTRY_POINTS: Final = "pebble.extensions"
_IMPORT_S = 60.0  # for a module of others: large libraries take half of it on a small board
_SECTION_KEY = re.compile(r"(services\.)?[A-Za-z]\w*", re.ASCII)
#: Our extensions in the order of their sections, with the keys of a config that belong to each. One that others use
#: stands before them.
OURS: Final[Mapping[str, tuple[str, ...]]] = {
    "pebble.extensions.media": ("services.mqtt_bridge.media",),
    "pebble.extensions.paho": (),
    "pebble.services.mqtt_bridge.requests": (),
    "pebble.extensions.operator": (),
    "pebble.extensions.scripts": (),
    "pebble.extensions.recordings": (),
    "pebble.services.av_daemon": ("services.av_daemon",),
    "pebble.services.camera_publisher": (),
    "pebble.services.audio_publisher": (),
    "pebble.services.audio_receiver": (),
    "pebble.services.video_stream": ("services.video_stream",),
    "pebble.services.soundboard_handler": ("services.soundboard_handler",),
    "pebble.services.autonomy_manager": ("services.autonomy_manager",),
    "pebble.services.recorder": ("services.recorder",),
    "pebble.services.neighbours": ("services.neighbours",),
    "pebble.services.ros1_bridge": ("services.ros1_bridge",),
    "pebble.services.homeassistant": ("services.homeassistant",),
    "pebble.extensions.thin": (),
    "pebble.extensions.fleet": (),
    "pebble.extensions.page": ("services.web_handler", "web_interface"),
    "pebble.services.serial_mcu_bridge.imu": (),
    "pebble.services.serial_mcu_bridge.pebble_serial_v1": (),
    "pebble.services.serial_mcu_bridge.devices": (),
    "pebble.extensions.foxglove": (),
    "pebble.extensions.metrics": (),
    "pebble.extensions.calibrate": (),
    "pebble.extensions.lab": (),
    "pebble.extensions.checks": (),
    "pebble.extensions.install": (),
}


class Stage(IntEnum):
    """A stage of stopping: programs of one stage stop together, those of the highest stage first."""

    LOCAL_TRANSPORT = 0  # what the others publish through
    ANNOUNCER = 1  # publishes how the others ended
    DEVICE = 2  # owns hardware
    CONNECTION = 3  # is connected to other machines


class Program(Struct, frozen=True):
    """A process: its name in logs and status, and what it runs with ``arguments``.

    It runs a service (``module:Class``), or a module as ``python -m`` runs it. The launcher imports the module before
    it forks: importing must do nothing. Import what only some robots need in the functions that use it: then it is in
    the memory of those robots only.
    """

    name: str
    module: str
    arguments: tuple[str, ...] = ()  # of an extension's program: the path of the config, unless it has others
    stage: Stage = Stage.CONNECTION
    reads_announcer_pipe: bool = False  # on its stdin; the others' stdin is empty
    runs_scripts: bool = False  # lines of its output may be a script's
    may_request: bool = False  # may request on-demand programs
    on_demand: bool = False  # runs only while it is requested
    plain: bool = False  # it reports nothing to the launcher, so it is ready once it runs
    preloaded: bool = True  # False: its imports are needed by few, and would cost every process their memory
    shares: tuple[str, ...] = ()  # modules that several programs use, imported before the first fork
    has_sockets: bool = False  # opens sockets in the run directory, whose path must then be short
    stop_timeout_s: float = 10.0  # after this an on-demand program that was released is killed
    webrtc_url: str | None = None  # where pages show its pictures


class Command(Struct, frozen=True):
    """A command of ``pebble``: ``module:function``, or a module with ``register(app)``, and its line of help."""

    place: str
    help: str
    group: Literal["use", "own", "write", "share", "measure", "more"] = "more"  # the heading in `pebble --help`
    rank: int = 100  # its place there


class Facts(Struct, frozen=True):
    """Lines that an extension adds to the summary of ``pebble check``: a name and a text each."""

    lines: tuple[tuple[str, str], ...] = ()  # beside those of the connections
    table: tuple[tuple[str, ...], ...] = ()  # below the table of topics


class Extension(Struct, frozen=True, kw_only=True, eq=False):
    """Declaration of what an extension adds. Parts are written ``module:name``; an empty one adds nothing.

    A robot whose config lists an extension with ``motors`` does not start without that extension.
    """

    name: str
    package: str = "pebble-robot"  # its name in messages
    extra: str = ""  # of the package: `pip install "PACKAGE[EXTRA]"` installs its dependencies
    packages: tuple[str, ...] = ()  # modules of other packages that its programs need
    needs: tuple[str, ...] = ()  # extensions without which it counts as not installed
    sections: dict[str, str] = {}  # by the key of the config, "services.lamp" or "lamp": its Section
    rules: str = ""  # pairs of a Section and check(reader, section, path), which returns the section
    program: Program | None = None  # runs while the section is enabled, or always where there is none
    programs: str = ""  # a function of the config: its other Programs
    prepare: str = ""  # a function of the config, called before its programs start
    observer: str = ""  # of config and clock: pebble.forwarding.observer.Observer, which sees what the bridge passes
    step: str = ""  # a function of the config: pebble.forwarding.observer.Step, which may refuse it
    requests: tuple[str, ...] = ()  # pebble.services.mqtt_bridge.own_requests.Requests, which the bridge fulfils
    uplink: str = ""  # pebble.services.mqtt_bridge.uplink.Uplink, where the link may be thin
    private: str = ""  # pebble.forwarding.observer.PrivateTopics, by which its topics stay on the robot
    names: str = ""  # pebble.forwarding.names.Names, where a robot's operators are known by name
    accounts: str = ""  # pebble.transports.zenoh.hub.admission.Admission, where a hub has a file of access
    offers: str = ""  # a function of config and CapabilitiesValue, which it returns completed
    facts: str = ""  # a function of the config: Facts
    checks: str = ""  # a function of the config, for `pebble doctor`: CheckResults
    commands: dict[str, Command] = {}  # by their words: "lamp", "fleet hub"
    former: dict[str, str] = {}  # commands of earlier releases, and how they are called now
    completions: dict[str, str] = {}  # by the name of an argument in help: a function of the context, the values
    protocols: dict[str, SerialProtocol] = {}  # of serial lines, by the config's `protocol`
    motors: dict[str, str] = {}  # its motor owners (pebble.motors.motor_owner) by name: the program
    page: str = ""  # where its documentation is


class Missing(Struct, frozen=True):
    """An extension that a config names and this machine lacks."""

    name: str
    key: str  # of the config
    reason: str
    drives: bool = False


def part(place: str) -> Any:
    """Return the object that ``module:name`` names, or the module of a place without a name."""
    module, _, name = place.partition(":")
    loaded = import_module(module)
    return getattr(loaded, name) if name else loaded


@cache
def ours() -> tuple[Extension, ...]:
    """Return our extensions that are installed with everything they need, in the order of ``OURS``."""
    installed: dict[str, Extension] = {}
    for module in OURS:
        extension = _declared(module)
        if extension is not None and all(need in installed for need in extension.needs):
            installed[extension.name] = extension
            SERIAL_PROTOCOLS.update(extension.protocols)  # the contract has only the core's
    return tuple(installed.values())


def _declared(module: str) -> Extension | None:
    """Return the extension that our ``module`` declares; None if it is not installed."""
    try:
        extension: Extension = import_module(module).EXTENSION
    except ModuleNotFoundError as error:
        is_missing = error.name is not None and f"{module}.".startswith(f"{error.name}.")  # it, or its package
        if not is_missing:  # it is there, and imports something that is not
            raise
        return None
    return extension


def named(
    entries: Mapping[str, bool], folder: Path, section: type
) -> tuple[tuple[Extension, ...], tuple[Missing, ...]]:
    """Return the extensions that a config lists, and those that could not be loaded.

    ``entries``: the names of entry points, or of files in ``folder`` such as ``lamp.py``; True: the config says that it
    owns motors. ``section``: the base class of sections. Raises ConfigError if the config is wrong about the motors.
    """
    loaded, missing = [], []
    for name, drives in entries.items():
        try:
            with _in_time():
                extension = _of_file(folder / name) if name.endswith(".py") else _of_package(name)
                _check_parts(extension, section)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - a module of others may raise anything, also SystemExit
            missing.append(Missing(name, f"extensions.{name}", _reason(error), drives))
            continue
        if extension.motors and not drives:
            raise ConfigError(f'extensions.{name}: it owns motors, write {{"drives": true}}')
        if drives and not extension.motors:
            why = "it declares no motors, so no stop would be confirmed: leave out drives"
            raise ConfigError(f"extensions.{name}: {why}")
        loaded.append(extension)
    return tuple(loaded), tuple(missing)


@contextmanager
def _in_time() -> Iterator[None]:
    """Raise PebbleError if importing a module of others in the ``with`` block takes too long. Main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(*_: object) -> None:
        raise PebbleError(f"it was not imported within {_IMPORT_S:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, _IMPORT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _reason(error: BaseException) -> str:
    """Return the message of an error in one line."""
    text = str(error) if isinstance(error, PebbleError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def _check_parts(extension: Extension, section: type) -> None:
    """Raise PebbleError for a mistake that would keep the robot from starting, or a stop from being confirmed."""
    lacks = {*extension.needs} - {other.name for other in ours()}
    if lacks:
        raise PebbleError(f"it needs {' and '.join(sorted(lacks))}")
    program = extension.program
    for name in (extension.name, *extension.motors, *([program.name] if program else ())):
        if re.search(LEVEL, name) is None:
            raise PebbleError(f"its name {name!r} is not {LEVEL_RULE}")
    for key, place in extension.sections.items():
        kind = part(place)
        if not _SECTION_KEY.fullmatch(key) or not (isinstance(kind, type) and issubclass(kind, section)):
            raise PebbleError(f'its section "{key}" is no Section, or no key of a config')
        kind()  # every key has a default
    for kind, check in part(extension.rules) if extension.rules else ():
        if not (isinstance(kind, type) and issubclass(kind, section) and callable(check)):
            raise PebbleError("its rules are no pairs of a Section and a function")
    if len(set(extension.motors.values())) < len(extension.motors):
        raise PebbleError("two of its motors are of one program, which can own one")
    if extension.programs:
        part(extension.programs)
    elif any(program is None or name != program.name for name in extension.motors.values()):
        raise PebbleError("its motors are of a program that it does not have")
    if program is not None and find_spec(program.module.partition(":")[0]) is None:
        raise PebbleError(f"the module of its program, {program.module}, is not installed")


def lacking(raw: Any) -> Iterator[Missing]:
    """Yield those of our extensions that the config uses but this machine lacks.

    The config uses an extension if it has a section of the extension that is not disabled.
    """
    unknown = keys_of_missing(ours())
    for module, keys in OURS.items():
        for key in keys:
            section = value_at(raw, *key.split("."))
            if key in unknown and section is not None and value_at(section, "enabled") is not False:
                name, path = module.rpartition(".")[2], module.replace(".", "/")
                install = f'pip install "pebble-robot[all]" ({path} is not there, or what it needs)'
                yield Missing(name, key, f"is of the extension {name}, which is not installed: {install}")


def keys_of_missing(installed: Iterable[Extension]) -> list[str]:
    """Return the config keys of our extensions that are not among ``installed``."""
    present = {key for extension in installed for key in extension.sections}
    return [key for keys in OURS.values() for key in keys if key not in present]


def value_at(raw: Any, *keys: str) -> Any:
    """Return the value at a path of keys in plain data; None where there is none."""
    for key in keys:
        raw = raw.get(key) if isinstance(raw, dict) else None
    return raw


def lacking_packages(extension: Extension) -> list[str]:
    """Return the modules of other packages that an extension needs, and that this Python does not have."""
    return [name for name in extension.packages if find_spec(name) is None]


def refuse_claims(core: Extension, extensions: Iterable[Extension]) -> None:
    """Raise ConfigError if two extensions add the same section, command, protocol or name; it names both.

    ``core`` declares what the core has.
    """
    claimed_by: dict[tuple[str, str], int] = {}  # places in ``listed``, by kind and name
    listed = (core, *extensions)  # told apart by their places, for an extension may be listed twice
    for number, extension in enumerate(listed):
        claims: dict[str, Iterable[str]] = {
            "section": extension.sections,
            "command": extension.commands,
            "protocol": extension.protocols,
            "extension": (extension.name,),
        }
        for kind, names in claims.items():
            for name in names:
                first = claimed_by.setdefault((kind, name), number)
                if first != number:
                    other = listed[first]
                    pair = f"{other.package} ({other.name}) and {extension.package} ({extension.name})"
                    raise ConfigError(f'extensions: {kind} "{name}" is added by two, {pair}: remove one of them')


def packages() -> Iterator[Extension]:
    """Yield the extensions of installed packages, for the command line. A broken one is logged and skipped."""
    for name in _offered():
        try:
            with _in_time():
                extension = _of_package(name)
            yield extension
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - a module of others may raise anything, also SystemExit
            log.error("the extension %s cannot be loaded: %s", name, _reason(error))


def motors_of(extensions: Iterable[Extension], config: Any) -> dict[str, str]:
    """Return those programs of extensions that own motors, by the name of the motor owner."""
    running = {program.name for program in programs_of(extensions, config)}
    owners = {owner: program for extension in extensions for owner, program in extension.motors.items()}
    return {owner: program for owner, program in owners.items() if program in running}


def programs_of(extensions: Iterable[Extension], config: Any, core: Iterable[str] = ()) -> list[Program]:
    """Return the processes that extensions add to a robot; ``core``: names of Pebble's own processes.

    A process that owns motors is put at the stage DEVICE. Raises ConfigError if a name is taken.
    """
    owners = dict.fromkeys(core, "the core")
    programs = []
    for extension in extensions:
        for program in _programs(extension, config):
            if other := owners.get(program.name):
                raise ConfigError(f'extensions: program "{program.name}" is of two, {other} and {extension.package}')
            owners[program.name] = extension.package
            if program.name in extension.motors.values():
                program = replace(program, stage=Stage.DEVICE, on_demand=False)
            if not program.arguments:
                program = replace(program, arguments=(str(config.path),))
            programs.append(program)
    return programs


def _programs(extension: Extension, config: Any) -> Iterator[Program]:
    sections = (reduce(getattr, key.split("."), config) for key in extension.sections)
    if extension.program is not None and all(getattr(section, "enabled", True) for section in sections):
        yield extension.program
    if extension.programs:
        yield from items(extension, "programs", Program, config)


def items(extension: Extension, hook: str, kind: type[T], *arguments: Any) -> list[T]:
    """Return the list that the function ``hook`` of an extension returns; raises the same errors as :func:`call`."""
    returned: list[T] = call(extension, hook, list, *arguments, finish=list)
    for item in returned:
        if not isinstance(item, kind):
            raise _failed(extension, hook, f"{type(item).__name__} is no {kind.__name__}")
    return returned


def call(
    extension: Extension, hook: str, kind: Any, *arguments: Any, finish: Callable[[Any], Any] = lambda value: value
) -> Any:
    """Call function ``hook`` of an extension and return its result.

    ``finish`` converts the result. Raises ConfigError with the extension and the hook if the call or ``finish`` fails,
    or if the result is no ``kind``.
    """
    try:
        value = finish(part(getattr(extension, hook))(*arguments))
    except PebbleError:
        raise
    except Exception as error:
        raise _failed(extension, hook, _reason(error)) from error
    if not isinstance(value, kind):
        raise _failed(extension, hook, f"{type(value).__name__} is no {kind.__name__}")
    return value


def _failed(extension: Extension, hook: str, why: str) -> ConfigError:
    return ConfigError(f"extensions: {hook} of {extension.package} ({extension.name}): {why}")


def _of_package(name: str) -> Extension:
    offered = _offered()
    if name not in offered:
        names = ", ".join(sorted(offered)) or "none"
        raise PebbleError(f'no installed package offers it (a file is written with ".py"); known are {names}')
    return _checked(part(offered[name]))


@cache
def _offered() -> Mapping[str, str]:
    """Return the extensions of installed packages by name, as ``module:name``."""
    from importlib.metadata import entry_points  # several MB, only for robots with an extension of others

    return {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}


def _of_file(path: Path) -> Extension:
    """Return the extension in an owner's file. Its module is named after the file, so ``lamp:Lamp`` is found.

    A file without the word EXTENSION is a program: it is run with the path of the config, and not imported here.
    """
    if not path.is_file():
        raise PebbleError(f"there is no file {path}")
    is_root = hasattr(os, "getuid") and os.getuid() == 0
    uid = 0
    if is_root:  # root runs only what root alone can change
        uid = path.stat().st_uid or owner_of(path, nameless=False).uid  # who can change it; 0: root
    if uid:
        why = "and root runs no code of other users: chown root it, in a folder of root's"
        raise PebbleError(f"{path} belongs to user {uid}, {why}")
    name = path.stem
    if "." in name:
        raise PebbleError(f'a module has no "." in its name: rename the file {path.name}')
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # its process runs it by name; last, so that it hides nothing
    origin = Path(getattr(find_spec(name), "origin", None) or "")  # the file that importing the name would run
    if not (origin.is_file() and origin.samefile(path)):
        raise PebbleError(f"a module is called {name} already: rename the file")
    if not re.search(r"\bEXTENSION\b", path.read_text(encoding="utf-8", errors="replace")):
        return Extension(name=name, package=path.name, program=Program(name, name, plain=True, preloaded=False))
    module = sys.modules.get(name)
    if module is None:
        spec = spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise PebbleError(f"{path} cannot be imported")
        module = sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return _checked(getattr(module, "EXTENSION", None))


def _checked(extension: Any) -> Extension:
    """Return ``extension`` if it is an Extension with values of the right types. Raises PebbleError."""
    if not isinstance(extension, Extension):
        raise PebbleError("its EXTENSION is no pebble.extension.Extension")
    try:
        msgspec.convert(msgspec.to_builtins(extension), Extension)
    except (TypeError, msgspec.ValidationError) as error:
        raise PebbleError(f"its EXTENSION is not as pebble.extension has it: {error}") from error
    return extension
