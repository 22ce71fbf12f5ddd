"""Facts about a robot's scripts for its capabilities, ``pebble check`` and Tab completion."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

import pebble
from pebble.config import Config, load
from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS
from pebble.contract.capabilities import CapabilitiesValue
from pebble.errors import PebbleError
from pebble.extension import Facts
from pebble.extensions.media.offers import files_offer
from pebble.extensions.scripts.config import AutonomyManager
from pebble.ownership import owner_of

if TYPE_CHECKING:
    from pebble.services.autonomy_manager.script import Script


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with the robot's scripts, among them a shipped one that computes odometry from touch sensors."""
    enabled = config.section(AutonomyManager).enabled
    telemetry: Any = value.telemetry
    telemetry = replace(telemetry, wheel_odometry=enabled and telemetry.touch_sensors)
    autonomy = files_offer(config, AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS, enabled)
    return replace(value, autonomy=autonomy, telemetry=telemetry)


def facts(config: Config) -> Facts:
    """Return the robot's scripts, each with whether it can run here."""
    if config.robot.platform != "linux" or not config.section(AutonomyManager).enabled:
        return Facts()
    try:
        from pebble.services.autonomy_manager.catalogue import Catalogue  # few checks need it
    except ModuleNotFoundError:  # a system without fcntl runs no robots
        return Facts()
    scans: list[dict[str, Script]] = []
    Catalogue(config, asks=False).scan(scans.append)  # calls append once, as no script is asked
    return Facts(table=tuple(("script", name, _fitness(config, script)) for name, script in scans[-1].items()))


def _fitness(config: Config, script: Script) -> str:
    """Return in words what runs the script and which modules are missing there, or why it does not run."""
    if script.broken:
        return f"does not run: {script.broken}"
    if script.ours:  # it uses pebble.script
        return "runs, Pebble's own"
    from pebble.services.autonomy_manager.environment import environment
    from pebble.services.autonomy_manager.interpreter import lacking

    is_probed = not script.own_program and _may_run(config, script)  # what its script.json names may be no Python
    missing = lacking(script.command, script.folder, environment(ours=False)) if is_probed else []
    return f"runs with {script.command[0]}" + (f", which lacks {', '.join(missing)}" if missing else "")


def _may_run(config: Config, script: Script) -> bool:
    """True if the script's Python may be run, to find which modules it lacks.

    It must be this machine's, outside of the config's folder, and the config must set no variables for it: otherwise
    the check of a config from elsewhere would run a program that came with it.
    """
    from pebble.services.autonomy_manager.environment import local_login

    program = Path(shutil.which(script.command[0]) or "/")  # "/": a missing one passes, as running it tells that
    set_variables = script.environment.keys() - local_login(config)  # without the login, which every script gets
    if set_variables or program.is_relative_to(config.folder):
        return False
    try:
        return owner_of(program, nameless=False).uid in (0, os.geteuid())
    except PebbleError:
        return False


def complete_scripts(context: Any) -> list[str]:
    """Return the names of a robot's scripts, by the given config; if it cannot be read, of Pebble's own scripts."""
    file = Path(str(context.params.get("robot")))
    folders: tuple[Path, ...] = (Path(pebble.__file__).with_name("extensions") / "scripts" / "shipped",)
    if file.is_file():
        from pebble.services.autonomy_manager.catalogue import roots

        with suppress(PebbleError):
            folders = roots(load(file))
    return sorted({path.parent.name for folder in folders for path in folder.glob("*/run.py")})
