"""Arguments and options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from pebble.config import hosts
from pebble.errors import PebbleError

ConfigArgument = Annotated[Path, typer.Argument(help="A robot's config file.", show_default=False)]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="A robot's config file: use its own transport.", metavar="CONFIG")
]
UrlOption = Annotated[
    str | None, typer.Option(help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL")
]
RemoteOption = Annotated[
    bool, typer.Option("--remote", help="With --config: the operators' remote broker, not the robot's local transport.")
]
PasswordFile = Annotated[
    Path | None, typer.Option(help="File with the broker's password; else $PEBBLE_PASSWORD.", metavar="FILE")
]
CaCert = Annotated[Path | None, typer.Option(help="Certificate authority to trust with mqtts://.", metavar="FILE")]
Output = Annotated[Path, typer.Option("--output", help="Folder for results and plots.", metavar="FOLDER")]
Quick = Annotated[bool, typer.Option("--quick", help="Few cases and short rounds; results are marked as quick.")]


def host_of(option: str, text: str, parse: Callable[[str], str] = hosts.host) -> str:
    """The host that an option names. Raises PebbleError."""
    try:
        return parse(text)
    except hosts.HostError as error:
        raise PebbleError(f"{option} {error}") from None


def split_names(text: str) -> list[str]:
    """The names in ``a,b, c``. Raises PebbleError if there is none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise PebbleError(f'"{text}" holds no name')
    return names
