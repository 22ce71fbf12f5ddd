"""Completions for Tab: files and robots of this machine, found without a network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from typer import Context

from pebble.ownership import read_plain

_PLACES = (Path(), Path("/etc/pebble"))
_FILES = 200  # that are looked into
_LONGEST = 1_000_000  # bytes of a config


def configs(context: Context) -> list[str]:
    """Return the JSON files of this folder. The shell itself completes other paths."""
    commands = ["user", "audit"] if context.command.name == "serve" else []  # of `pebble web [CONFIG]`
    return [*commands, *sorted(str(path) for path in Path().glob("*.json"))]


def robots(context: Context) -> list[str]:
    """Return the JSON files of this folder, and the ids of robots whose configs are here or in /etc/pebble."""
    return [*configs(context), *sorted(set(_ids()))]


def stops(context: Context) -> list[str]:
    """Return the robots, and the verbs of ``pebble estop``."""
    return ["reset", "status", *robots(context)]


def _ids() -> Iterator[str]:
    for file in islice((file for place in _PLACES for file in place.glob("*.json")), _FILES):
        try:
            if file.stat().st_size <= _LONGEST:
                yield str(json.loads(read_plain(file))["robot"]["id"])
        except (OSError, ValueError, LookupError, TypeError):  # no config of a robot
            continue
