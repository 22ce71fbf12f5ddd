"""What Tab completes besides commands and options: files and robots of this machine, without a network."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from typer import Context
from typer.core import TyperGroup

from pebble.extension import ours, part
from pebble.ownership import read_plain

_PLACES = (Path(), Path("/etc/pebble"))
_FILES = 200  # that are looked into
_LONGEST = 1_000_000  # bytes of a config


class Completion(NamedTuple):
    """A value, as a shell gets it."""

    value: str
    type: str = "plain"
    help: str | None = None


def complete_values(command: Any) -> None:
    """Let a command, and those below it, complete the values of arguments and options that ``VALUES`` has."""
    for parameter in command.params:
        name = parameter.metavar or ""
        added = next((one.completions[name] for one in ours() if name in one.completions), "")
        if values := part(added) if added else VALUES.get(name):
            parameter.shell_complete = partial(_items, values)
    for below in command.commands.values() if isinstance(command, TyperGroup) else ():
        complete_values(below)


def _items(values: Callable[[Context], list[str]], context: Context, incomplete: str) -> list[Completion]:
    return [Completion(value) for value in values(context) if value.startswith(incomplete)]


def configs(context: Context) -> list[str]:
    """Return the JSON files of this folder; the shell itself completes those of others."""
    commands = ["user", "audit"] if context.command.name == "serve" else []  # of `pebble web [CONFIG]`
    return [*commands, *sorted(str(path) for path in Path().glob("*.json"))]


def robots(context: Context) -> list[str]:
    """Return the JSON files of this folder, and the ids of robots whose configs are here or in /etc/pebble."""
    return [*configs(context), *sorted(set(_ids()))]


def _ids() -> Iterator[str]:
    for file in islice((file for place in _PLACES for file in place.glob("*.json")), _FILES):
        try:
            if file.stat().st_size <= _LONGEST:
                yield str(json.loads(read_plain(file))["robot"]["id"])
        except (OSError, ValueError, LookupError, TypeError):  # no config of a robot
            continue


#: Functions for the values of arguments and options, by how the help calls them. Extensions add theirs.
VALUES: Final = {
    "CONFIG": configs,
    "CONFIG…": configs,
    "ROBOT": robots,
    "[SYSTEM/TYPE/]ID": robots,
    "[reset|status] ROBOT": lambda context: ["reset", "status", *robots(context)],
}
