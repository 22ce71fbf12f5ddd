"""Puts the files of a backup in their places on a machine that is no robot yet; nothing is overwritten.

The backup may have been changed, so root does not trust it to say what to run, read, delete or let in.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pebble.config.problems import Notes
from pebble.config.raw import decode, plain
from pebble.config.text_files import text_of
from pebble.extensions.fleet import applying
from pebble.extensions.fleet.folder import FLEET, load
from pebble.extensions.install.setup import backup as backups
from pebble.extensions.install.setup import own_broker
from pebble.extensions.install.setup.backup import Saved
from pebble.extensions.install.setup.robot_config import COMMANDS
from pebble.extensions.install.setup.system import MOSQUITTO, ROBOT, ROBOTS, SetupError, System
from pebble.extensions.operator.places import Places
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner

_SHARED = ("root:root", 0o755)  # owner and mode of folders that other programs use, too
#: What a backup may hold, below the root: who owns it there, and the mode of its folders.
_PLACES = {
    "etc/pebble": (ROBOTS, 0o750),
    "var/lib/pebble": (ROBOT, 0o700),
    "etc/mosquitto/pebble": (MOSQUITTO, 0o700),
    "etc/mosquitto": _SHARED,
}
_RUNS = ("command", "extensions", "env", "python", "entrypoint")  # keys of programs, and of what these are told
_SCRIPT = ("/run.py", "/script.json")  # by these a folder is one
_OWN = ("/etc/pebble/", "/var/lib/pebble/", "/dev/")  # what a robot may name without a question


def restore(system: System, file: Path, agree: Callable[[Sequence[str]], None]) -> str:
    """Write the files of a backup, the config last, and return the robot's name.

    Before anything is written it raises BackupError for an incomplete backup, and SetupError for one that would write
    elsewhere or for a machine with other files in these places. ``agree`` is called with the programs that its config
    runs, the foreign files that it names, and its scripts; it raises to prevent the restore.
    """
    backup, places = backups.read(file), system.places
    config = str(places.config.relative_to(places.root))
    files = _allowed(backup.files, places)
    if config not in backup.files:
        raise SetupError(f"{file}: has no {config}: it is no backup of a robot that is installed")
    files[config] = files.pop(config)  # the last one to be written
    for name in reversed(files):  # the config first: if this is a robot already, the error names it
        if not _place(name):
            raise SetupError(f"the backup would write {name!r}, which is no file of a robot")
        target = places.root / name
        with as_owner(target.parent):
            if os.path.lexists(target) and _content(target) != files[name].content:
                why = "is there already, with other content: only a blank machine becomes this robot"
                raise SetupError(f"{target} {why}")
    scripts = (f"/{name}" for name in files if name.endswith(_SCRIPT))
    settings = plain(decode(text_of(files[config].content), config), Notes())  # flaws are reported when it is loaded
    if foreign := [*_foreign(settings), *scripts]:
        agree(foreign)
    for place in {_place(name) for name in files}:
        system.owner(_PLACES[place][0])  # raises if there is no such user, as without mosquitto
    for name, saved in files.items():
        target = places.root / name
        for folder in reversed(target.parents):
            if not folder.exists():
                # With the slash `_place` finds the entry of a folder that is itself in _PLACES, too.
                owner, mode = _PLACES.get(_place(f"{folder.relative_to(places.root)}/"), _SHARED)
                system.make_folder(folder, mode, owner)
        if not places.unfinished.exists() and places.etc.is_dir():
            system.write(places.unfinished, b"")  # with it no service uses the files before setup has done its steps
        if not target.exists():
            owner, _ = _PLACES[_place(name)]
            system.write(target, saved.content, saved.mode & 0o755, owner)  # only the owner may write
    if (places.broker_folder / FLEET).is_file():
        # The broker's rules in the backup may have been changed: they are made anew from its accounts.
        with as_owner(places.broker_folder):
            own_broker.link(places.broker_folder)
            fleet, passwords = load(places.broker_folder), applying.passwords_of(places.broker_folder)
            applying.write_rules(places.broker_folder, fleet, passwords)
    return backup.about.id


def _content(file: Path) -> bytes:
    try:
        return read_plain(file)
    except OSError as error:
        raise SetupError(f"{file}: {error.strerror}") from None


def _allowed(files: dict[str, Saved], places: Places) -> dict[str, Saved]:
    """Return the files to restore: of those in /etc/mosquitto only the broker's folder, without its links.

    These links, and the configuration that mosquitto includes, are made anew, as the backup may have been changed.
    """
    folder = f"{places.broker_folder.relative_to(places.root)}/"
    links = [f"{folder}{name}" for name in own_broker.LINKS]
    broker = str(places.broker.relative_to(places.root))
    allowed = {
        name: saved
        for name, saved in files.items()
        if name not in links and (name.startswith(folder) or not name.startswith("etc/mosquitto/"))
    }
    if broker in files:  # its text is the same for every fleet: it names no account
        allowed[broker] = Saved(own_broker.conf_text(places, own_broker.fleet_of("robot", "", places.people)), 0o644)
    if any(name.startswith(folder) for name in allowed) and f"{folder}{FLEET}" not in allowed:
        raise SetupError(f"the backup has files of a broker, and no {folder}{FLEET}: it was changed")
    return allowed


def _foreign(value: Any, *keys: str) -> Iterator[str]:
    """Yield ``KEY: VALUE`` for each program that setup never puts into a config, and each file not the robot's."""
    key = keys[-1] if keys else ""
    is_run = key in _RUNS or key.endswith(("_command", "_env"))
    is_other_program = is_run and value and value not in COMMANDS
    is_other_file = not is_run and isinstance(value, str) and _is_foreign_path(value)
    if is_other_program or is_other_file:
        yield f"{'.'.join(keys)}: {' '.join(map(str, value)) if isinstance(value, list | dict) else value}"
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _foreign(item, *keys, str(name))
    elif isinstance(value, list) and not is_run:
        for item in value:
            yield from _foreign(item, *keys)


def _is_foreign_path(text: str) -> bool:
    """True if a text looks like the path of a file that is not the robot's."""
    if not text.startswith(("/", "~", "file:")) and ".." not in text.split("/"):
        return False
    path = os.path.normpath(text if text[0] in "/~" else f"/etc/pebble/{text}")
    return not f"{path}/".startswith(_OWN)


def _place(name: str) -> str:
    """Return the key of ``_PLACES`` below which this file belongs; empty if there is none."""
    return next((place for place in _PLACES if name.startswith(f"{place}/")), "")
