"""Puts the files of a backup in their places on a machine that is no robot yet; nothing is overwritten."""

from pathlib import Path

from pebble.extensions.install.setup import backup as backups
from pebble.extensions.install.setup import own_broker
from pebble.extensions.install.setup.system import MOSQUITTO, ROBOT, ROBOTS, SetupError, System

#: What a backup may hold, below the root: who owns it there, and the mode of its folders.
_PLACES = {
    "etc/pebble": (ROBOTS, 0o750),
    "var/lib/pebble": (ROBOT, 0o700),
    "etc/mosquitto/pebble": (MOSQUITTO, 0o700),
    "etc/mosquitto": ("root:root", 0o755),
}


def restore(system: System, file: Path) -> str:
    """Write the files of a backup, the config last, and return the robot's name.

    Before anything is written, raises BackupError for what is no whole backup, and SetupError for one that would write
    elsewhere, and for a machine that has other files in these places.
    """
    backup, places = backups.read(file), system.places
    config, manifest = (str(file.relative_to(places.root)) for file in (places.config, places.manifest))
    files = {name: saved for name, saved in backup.files.items() if name not in (config, manifest)}
    if config not in backup.files:
        raise SetupError(f"{file}: has no {config}: it is no backup of a robot that is installed")
    files[config] = backup.files[config]
    for name in reversed(files):
        if not _place(name):
            raise SetupError(f"the backup would write {name}, which is no file of a robot")
        target = places.root / name
        if target.exists() and target.read_bytes() != files[name].content:
            raise SetupError(f"{target} is there already, with other content: only a blank machine becomes this robot")
    for place in {_place(name) for name in files}:
        system.owner(_PLACES[place][0])  # without mosquitto the robot's broker has no owner
    for name, saved in files.items():
        target, owner = places.root / name, _PLACES[_place(name)][0]
        for folder in reversed(target.parents):
            if not folder.exists():
                owner_there, mode = _PLACES.get(_place(f"{folder.relative_to(places.root)}/"), _PLACES["etc/mosquitto"])
                system.make_folder(folder, mode, owner_there)
        if not places.unfinished.exists() and places.etc.is_dir():
            system.write(places.unfinished, b"")
        if not target.exists():
            system.write(target, saved.content, saved.mode & 0o755, owner)
    if places.broker_folder.is_dir():
        own_broker.link(places.broker_folder)
    return backup.about.id


def _place(name: str) -> str:
    return next((place for place in _PLACES if name.startswith(f"{place}/")), "")
