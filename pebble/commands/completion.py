"""What Tab completes besides commands and options: files and robots of this machine, without a network."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from typer._click.shell_completion import CompletionItem
from typer.core import TyperGroup

import pebble

if TYPE_CHECKING:
    from typer._click.core import Command, Context

_PLACES = (Path(), Path("/etc/pebble"))
_FILES = 200  # that are looked into
_LONGEST = 1_000_000  # bytes of a config


def complete_values(command: Command) -> None:
    """Let a command, and those below it, complete the values of arguments and options that ``VALUES`` has."""
    for parameter in command.params:
        if values := VALUES.get(parameter.metavar or ""):
            parameter.shell_complete = partial(_items, values)  # type: ignore[method-assign]
    for below in command.commands.values() if isinstance(command, TyperGroup) else ():
        complete_values(below)


def _items(values: Callable[[Context], list[str]], context: Context, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(value) for value in values(context) if value.startswith(incomplete)]


def configs(context: Context) -> list[str]:
    """Return the JSON files of this folder; the shell itself completes those of others."""
    commands = ["user", "audit"] if context.command.name == "serve" else []  # of `pebble web [CONFIG]`
    return [*commands, *sorted(str(path) for path in Path().glob("*.json"))]


def robots(context: Context) -> list[str]:
    """Return the JSON files of this folder, and the ids of robots whose configs are here or in /etc/pebble."""
    return [*configs(context), *sorted(set(_ids()))]


def scripts(context: Context) -> list[str]:
    """Return the scripts of the robot whose config was given, else those of Pebble."""
    file = Path(str(context.params.get("robot")))
    folders: tuple[Path, ...] = (Path(pebble.__file__).with_name("extensions") / "scripts" / "shipped",)
    if file.is_file():
        from pebble.config import load
        from pebble.errors import PebbleError
        from pebble.services.autonomy_manager.catalogue import roots

        with suppress(PebbleError):
            folders = roots(load(file))
    return sorted({path.parent.name for folder in folders for path in folder.glob("*/run.py")})


def _ids() -> Iterator[str]:
    for file in islice((file for place in _PLACES for file in place.glob("*.json")), _FILES):
        try:
            if file.stat().st_size <= _LONGEST:
                yield str(json.loads(file.read_bytes())["robot"]["id"])
        except (OSError, ValueError, LookupError, TypeError):  # no config of a robot
            continue


#: Functions for the values of arguments and options, by how the help calls them.
VALUES: Final = {
    "CONFIG": configs,
    "CONFIG…": configs,
    "ROBOT": robots,
    "[SYSTEM/TYPE/]ID": robots,
    "[reset|status] ROBOT": lambda context: ["reset", "status", *robots(context)],
    "SCRIPT": scripts,
}
