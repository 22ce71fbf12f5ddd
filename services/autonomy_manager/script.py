"""A script of the catalogue, and the plan to start it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct

from pebble.contract.identity import meant
from pebble.errors import PebbleError
from pebble.extensions.operator.client.forms import Setting, SettingError, Value, arguments, effective, shown


class StartError(PebbleError):
    """An error: a start is refused. The text is for the person who asked for it."""


class StoppedError(StartError):
    """An error: a start is refused until the emergency stop is reset."""


class UnknownScriptError(StartError):
    """An error: the script is not listed, or its dependencies are not known yet."""


class Dependency(Struct, frozen=True, forbid_unknown_fields=True):
    """A script that must run while another one runs, and its settings."""

    file: str
    config: dict[str, Any] = {}


class Script(Struct, frozen=True, kw_only=True):
    """A script of the catalogue. ``command`` is followed by ``--config PATH`` and the options."""

    file: str  # the name of its folder
    label: str
    command: tuple[str, ...]
    folder: Path  # to run it in
    settings: tuple[Setting, ...] = ()
    summary: str = ""  # what it does, in one sentence
    main: tuple[str, ...] = ()  # the settings that operators see first
    dependencies: tuple[Dependency, ...] = ()
    environment: dict[str, str] = {}
    ours: bool = False  # it uses pebble.script, which signs its drive commands and stops the wheels at its end
    broken: str = ""  # why it cannot be started
    asked: bool = True  # False: its settings and what it needs are not known yet
    own_program: bool = False  # its `script.json` names what runs it
    drives: bool = True  # it may move the robot, so an emergency stop ends it


class Step(Struct, frozen=True):
    """A process of a plan, with its command line."""

    script: Script
    options: tuple[str, ...]


class Plan(Struct, frozen=True):
    """A checked start: the script, the scripts that it needs in order, and the effective settings."""

    main: Step
    dependencies: tuple[Step, ...]
    config: dict[str, Value]

    @property
    def drives(self) -> bool:
        """True unless all its processes only measure."""
        return any(step.script.drives for step in (self.main, *self.dependencies))


def plan(scripts: Mapping[str, Script], file: str, config: Mapping[str, Any]) -> Plan:
    """Return the plan for a start, after checking it. Raises StartError."""
    script = _named(scripts, file, f"Unknown autonomy file: {shown(file)}")
    _check(script, f"Failed to start {script.label}")
    step, values = _step(script, config, f"Invalid config for {script.label}")
    needed = tuple(_dependency(scripts, script.label, dependency) for dependency in script.dependencies)
    return Plan(step, needed, values)


def _dependency(scripts: Mapping[str, Script], label: str, dependency: Dependency) -> Step:
    failed = f"Failed to start {label}"
    script = _named(scripts, dependency.file, f"{failed}: Dependency script not found: {shown(dependency.file)}")
    _check(script, f"{failed}: {dependency.file}")
    return _step(script, dependency.config, f"{failed}: Invalid config for {dependency.file}")[0]


def _named(scripts: Mapping[str, Script], file: str, unknown: str) -> Script:
    """Return the script that ``file`` means. Raises StartError with the text ``unknown``."""
    try:
        script = scripts.get(meant(scripts, file))
    except PebbleError as error:
        raise StartError(f"{unknown}: {error}") from None
    if script is None:
        raise UnknownScriptError(unknown)
    return script


def _check(script: Script, failed: str) -> None:
    if script.broken:
        raise StartError(f"{failed}: {script.broken}")
    if not script.asked:
        raise UnknownScriptError(f"{failed}: it is still asked what it needs")


def _step(script: Script, config: Mapping[str, Any], failed: str) -> tuple[Step, dict[str, Value]]:
    try:
        values = effective(script.settings, config)
    except SettingError as error:
        raise StartError(f"{failed}: {error}") from None
    return Step(script, tuple(arguments(script.settings, values))), values
