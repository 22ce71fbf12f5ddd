"""Facts about a robot's scripts, for its capabilities, for ``pebble check`` and for what Tab completes."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

import pebble
from pebble.config import Config, load
from pebble.contract.capabilities import CapabilitiesValue, offered
from pebble.errors import PebbleError
from pebble.extension import Facts
from pebble.extensions.scripts.config import AutonomyManager

if TYPE_CHECKING:
    from pebble.services.autonomy_manager.script import Script


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with the robot's scripts; one of them computes odometry from its touch sensors."""
    enabled = config.section(AutonomyManager).enabled
    telemetry: Any = value.telemetry
    telemetry = replace(telemetry, wheel_odometry=enabled and telemetry.touch_sensors)
    return replace(value, autonomy=offered(value.autonomy, enabled), telemetry=telemetry)


def facts(config: Config) -> Facts:
    """Return the scripts that would be offered, each with whether it can run here."""
    if config.robot.platform != "linux" or not config.section(AutonomyManager).enabled:
        return Facts()
    try:
        from pebble.services.autonomy_manager.catalogue import Catalogue  # few checks need it
    except ModuleNotFoundError:  # a system without fcntl runs no robots
        return Facts()
    found: list[dict[str, Script]] = []
    Catalogue(config, asks=False).scan(found.append)
    return Facts(table=tuple(("script", name, _fitness(script)) for name, script in found[-1].items()))


def _fitness(script: Script) -> str:
    if script.broken or script.ours:
        return f"does not run: {script.broken}" if script.broken else "runs, Pebble's own"
    from pebble.services.autonomy_manager.environment import environment
    from pebble.services.autonomy_manager.interpreter import lacking

    is_asked = not script.own_program and _may_run(script.command[0])
    missing = lacking(script.command, script.folder, environment(script.environment, ours=False)) if is_asked else []
    return f"runs with {script.command[0]}" + (f", which lacks {', '.join(missing)}" if missing else "")


def _may_run(program: str) -> bool:
    """True unless this is root, and the program is of another user."""
    from pebble.runtime.as_owner import require_own

    try:
        require_own(Path(shutil.which(program) or program).parent)
    except PebbleError:
        return False
    return True


def complete_scripts(context: Any) -> list[str]:
    """Return the scripts of the robot whose config was given, else those of Pebble."""
    file = Path(str(context.params.get("robot")))
    folders: tuple[Path, ...] = (Path(pebble.__file__).with_name("extensions") / "scripts" / "shipped",)
    if file.is_file():
        from pebble.services.autonomy_manager.catalogue import roots

        with suppress(PebbleError):
            folders = roots(load(file))
    return sorted({path.parent.name for folder in folders for path in folder.glob("*/run.py")})
