"""What Tab completes of a command line, besides commands and options: files and robots of this machine, no network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

import typer

import pebble

_PLACES = (Path(), Path("/etc/pebble"))
_FILES = 200  # that are looked into
_LONGEST = 1_000_000  # bytes of a config


def configs() -> list[str]:
    """Return the JSON files of this folder; the shell itself completes those of others."""
    return sorted(str(path) for path in Path().glob("*.json"))


def robots() -> list[str]:
    """Return the JSON files of this folder, and the ids of robots whose configs are here or in /etc/pebble."""
    return [*configs(), *sorted(set(_ids()))]


def scripts(ctx: typer.Context) -> list[str]:
    """Return the scripts of the robot whose config was given, else those of Pebble."""
    file = Path(str(ctx.params.get("robot")))
    folders: tuple[Path, ...] = (Path(pebble.__file__).with_name("scripts"),)
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
