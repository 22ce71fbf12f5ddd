"""Puts the files of a backup in their places: of the same robot, or as a second one with passwords of its own."""

import hashlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import msgspec

from pebble.config.config import file_name
from pebble.fleet.people import People
from pebble.fleet.whole_file import write
from pebble.setup import backup as backups
from pebble.setup import manifest as manifests
from pebble.setup import own_broker
from pebble.setup.manifest import Manifest, SetupError
from pebble.setup.plan import base_of
from pebble.setup.steps import BESIDE, Engine

#: What a backup may hold, below the root, and who owns it there.
_OWNERS = {
    "etc/pebble": "root:pebble",
    "var/lib/pebble": "pebble:pebble",
    "etc/mosquitto/pebble": "mosquitto:mosquitto",
    "etc/mosquitto": "root:root",
}
#: What a second robot gets anew.
_SECRET = ("etc/mosquitto/", "etc/pebble/tls/", "etc/pebble/broker.password", "etc/pebble/page.password")


class Backup(NamedTuple):
    """A backup that has been read whole, and checked. ``files``: by their paths below the root: mode and content."""

    head: backups.About
    files: dict[str, tuple[int, bytes]]
    digest: str

    @property
    def manifest(self) -> Manifest:
        """What the robot was answered. Raises SetupError where it was not set up by this command."""
        try:
            return manifests.decode(self.files["etc/pebble/setup.json"][1])
        except KeyError:
            raise SetupError("the backup has no answers: it is of a robot that `pebble setup` did not make") from None
        except msgspec.MsgspecError as error:
            raise SetupError(f"the backup's etc/pebble/setup.json: {error}") from None


def read(file: Path) -> Backup:
    """Raises BackupError for what is no backup, and SetupError for one that would write elsewhere."""
    found = backups.read(file)
    if foreign := [name for name in found.files if not _prefix(name)]:
        raise SetupError(f"the backup would write {foreign[0]}, which is no file of a robot")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return Backup(found.about, {name: (one.mode & 0o755, one.content) for name, one in found.files.items()}, digest)


def _prefix(name: str) -> str:
    return next((prefix for prefix in _OWNERS if name.startswith(f"{prefix}/")), "")


def begin(backup: Backup, *, second: bool) -> Manifest:
    """The manifest to begin with: the backup's, of which a second robot leaves out what it gets anew."""
    manifest = backup.manifest
    manifest.restoring, manifest.ran = backup.digest, {}
    manifest.folders = [name for name in manifest.folders if not second or not f"{name[1:]}/".startswith(_SECRET)]
    if second:
        manifest.leaving = []
        manifest.files = {name: one for name, one in manifest.files.items() if not name[1:].startswith(_SECRET)}
    return manifest


def put(engine: Engine, backup: Backup, *, second: bool) -> Iterator[str]:
    """Write the files; yields what the user must look at. Overwrites nothing. Raises SetupError."""
    places = engine.places
    own = file_name(base_of(backup.head.id))
    for name, (mode, content) in backup.files.items():
        target = places.root / name
        if target == places.manifest or (second and (name.startswith(_SECRET) or own in target.name)):
            continue  # the first robot's stop, audit and passwords are its own
        if second and target == places.config:
            if not engine.manifest.is_ours(places.named(target), content):
                target = target.with_name(f"{target.name}.of-{backup.head.id}")
                yield f"the config was changed by hand: take over what you need from {places.named(target)}"
            else:
                continue  # it is written with the new name
        if target.exists() and target.read_bytes() != content:
            target = target.with_name(target.name + BESIDE)
            yield f"{places.root / name} was there already: the backup's is {target.name}"
        _parents(engine, target)
        write(target, content, mode, SetupError, engine.owner(_OWNERS[_prefix(name)]))
    if places.broker_folder.is_dir():
        own_broker.link(places.broker_folder)
    if second and places.people.exists():
        with closing(People(places.people)) as people:
            people.end_sessions()


def _parents(engine: Engine, target: Path) -> None:
    for folder in reversed(target.parents):
        if not folder.exists():
            name = str(folder.relative_to(engine.places.root))
            owner = engine.owner(_OWNERS.get(_prefix(f"{name}/"), "root:root"))
            folder.mkdir(mode=0o755)
            modes = {"": 0o755, "etc/mosquitto": 0o755, "etc/pebble": 0o750}
            manifests.finish_folder(folder, modes.get(_prefix(f"{name}/"), 0o700), owner)


def check(backup: Backup, there: Manifest | None) -> None:
    """Raise SetupError on a machine that is another robot already, unless this very restoring was interrupted."""
    if there is not None and there.restoring != backup.digest:
        name = there.answers.get("id")
        raise SetupError(f"this machine is set up as {name}: pebble setup --undo first, or leave out --from")
