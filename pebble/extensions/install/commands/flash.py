"""``pebble flash``: installs a robot's firmware on its board, step by step."""

import os
import sys
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from pebble.config import Config, load
from pebble.config.text_files import read_password
from pebble.errors import PebbleError
from pebble.extensions.install.flash import ports
from pebble.extensions.install.flash.boards import FIRMWARE, Firmware, firmware_named
from pebble.extensions.install.flash.private import PrivateFiles, check_broker, private_files
from pebble.extensions.install.flash.steps import FlashOptions, execute, show_steps
from pebble.runtime.environment import withhold

WIFI_PASSWORD = "PEBBLE_WIFI_PASSWORD"  # noqa: S105 - the name of an environment variable
_OF_PLATFORM = {"esp32": "minilamp", "esp8266": "benjr"}


def flash(
    robot: Annotated[
        str,
        typer.Argument(
            help=f"A robot's config file, or a firmware's name: {', '.join(FIRMWARE)}.",
            metavar="ROBOT",
            show_default=False,
        ),
    ],
    port: Annotated[
        str | None, typer.Option(help="The board's serial port.", metavar="PORT", show_default=False)
    ] = None,
    micropython: Annotated[
        Path | None,
        typer.Option(help="Erase the board and install this MicroPython first (.bin or .uf2).", show_default=False),
    ] = None,
    wifi: Annotated[
        str | None, typer.Option(help="Name of the Wi-Fi, for robots with Wi-Fi.", metavar="SSID", show_default=False)
    ] = None,
    wifi_password_file: Annotated[
        Path | None,
        typer.Option(help=f"File with its password; else ${WIFI_PASSWORD}, else a prompt.", show_default=False),
    ] = None,
    firmware: Annotated[
        str | None, typer.Option(help="The firmware, if the config does not determine it.", show_default=False)
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print every step without executing it.")] = False,
    verify: Annotated[bool, typer.Option(help="Wait until the robot publishes.")] = True,
) -> int:
    """Install a robot's firmware on its board.

    Robots with Wi-Fi get identity and broker from their config; passwords are stored only on the board.

    \b
        pebble flash goob --port /dev/ttyACM0 --dry-run
        pebble flash minilamp.json --port /dev/ttyACM0 --wifi Lab
    """
    target, config = _target(robot, firmware)
    if port is None:
        raise PebbleError(f"--port is missing: {ports.hint()}")
    options = FlashOptions(
        firmware=target,
        port=port,
        config=config,
        private=_private(config, target, wifi, wifi_password_file, dry_run) if target.has_wifi else None,
        micropython=micropython,
        verify=verify,
    )
    if config is not None and target.has_wifi:
        for warning in config.warnings:
            typer.echo(f"warning: {warning}", err=True)
    password_variables = () if config is None else config.password_variables
    withhold((WIFI_PASSWORD, *password_variables))  # from the programs that are started below
    if dry_run:
        show_steps(options, typer.echo)
        return 0
    execute(options, typer.echo)
    typer.echo(f"{robot}: done")
    return 0


def _target(robot: str, firmware: str | None) -> tuple[Firmware, Config | None]:
    """Return the firmware and the config for ``robot``, the path of a config or the name of a firmware.

    For a name it is the config that comes with Pebble; None for a firmware without Wi-Fi, which needs none.
    """
    if robot in FIRMWARE:
        target = firmware_named(firmware or robot)
        shipped = Path(str(files("pebble")), "configs", f"{robot}.json")
        return target, load(shipped) if target.has_wifi else None
    if not Path(robot).exists():
        raise PebbleError(f"{robot}: neither a file nor one of {', '.join(FIRMWARE)}")
    config = load(Path(robot))
    if firmware is not None:
        return firmware_named(firmware), config
    name = _OF_PLATFORM.get(config.robot.platform, config.robot.id)
    if name not in FIRMWARE:
        raise PebbleError(f"{robot} does not determine the firmware of its MCU: --firmware {'|'.join(FIRMWARE)}")
    return firmware_named(name), config


def _private(
    config: Config | None, firmware: Firmware, ssid: str | None, password_file: Path | None, dry_run: bool
) -> PrivateFiles:
    """Return a board's private files; in a dry run with placeholders for its Wi-Fi. Raises PebbleError if one lacks."""
    if config is None:
        raise PebbleError(f"{firmware.name} needs its config file: it names the broker")
    if dry_run:
        return private_files(config, firmware, ssid=ssid or "(--wifi)", wifi_password="")
    if ssid is None:
        raise PebbleError(f"--wifi: {config.robot.id} needs the name of its Wi-Fi")
    check_broker(config)
    return private_files(config, firmware, ssid=ssid, wifi_password=_wifi_password(ssid, password_file))


def _wifi_password(ssid: str, file: Path | None) -> str:
    """Return the Wi-Fi password from a file, from the environment, or from the terminal.

    Never from the command line, where every user of this machine could read it.
    """
    if file is not None:
        return read_password(file, "--wifi-password-file")
    if WIFI_PASSWORD in os.environ:
        return os.environ[WIFI_PASSWORD]
    if not sys.stdin.isatty():
        raise PebbleError(
            f"the password of {ssid}: use --wifi-password-file FILE or ${WIFI_PASSWORD}, stdin is not a terminal"
        )
    return str(typer.prompt(f"password of {ssid} (empty: none)", default="", hide_input=True, show_default=False))
