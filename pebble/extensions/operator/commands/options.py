"""Arguments and options that several commands of extensions share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from pebble.errors import PebbleError

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="A robot's config file: use its own transport.", metavar="CONFIG")
]
RobotArgument = Annotated[
    str,
    typer.Argument(
        help="A robot's config file, or with --url or --config its id.", metavar="ROBOT", show_default=False
    ),
]
UrlOption = Annotated[
    str | None, typer.Option("--url", help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL")
]
BrokerUrl = Annotated[
    str | None,
    typer.Option("--url", help="mqtt://[USER@]HOST[:PORT] or mqtts://… of the robots' broker.", metavar="URL"),
]
RemoteOption = Annotated[
    bool, typer.Option("--remote", help="With --config: the operators' remote broker, not the robot's local transport.")
]
PasswordFile = Annotated[
    Path | None, typer.Option(help="File with the broker's password; else $PEBBLE_PASSWORD.", metavar="FILE")
]
CaCert = Annotated[Path | None, typer.Option(help="Certificate authority to trust with mqtts://.", metavar="FILE")]
RobotOption = Annotated[
    str | None, typer.Option("--robot", "-r", help="The robot that short names refer to.", metavar="[SYSTEM/TYPE/]ID")
]
RootOption = Annotated[
    Path, typer.Option("--root", help="Folder that stands for / where the robot is installed.", metavar="DIR")
]
Output = Annotated[Path, typer.Option("--output", help="Folder for results and plots.", metavar="FOLDER")]
Quick = Annotated[bool, typer.Option("--quick", help="Few cases and short rounds; results are marked as quick.")]


def host_of(option: str, text: str, parse: Callable[[str], str] | None = None) -> str:
    """Return the host that an option names, as ``parse`` returns it; by default any host. Raises PebbleError."""
    from pebble.config import hosts  # not all commands that use this module have one

    try:
        return (parse or hosts.host)(text)
    except hosts.HostError as error:
        raise PebbleError(f"{option} {error}") from None


def split_names(text: str) -> list[str]:
    """Return the names in ``a,b, c``. Raises PebbleError if there is none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise PebbleError(f'"{text}" holds no name')
    return names
