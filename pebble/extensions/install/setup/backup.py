"""Packs into one tar file what a new machine needs to be this robot, and reads it again.

The first member is ``backup.json``, an :class:`About`; the others are files at their paths below the root, without the
leading slash. Recordings are not in it.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import sqlite3
import tarfile
import time
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import msgspec

from pebble.config import Config, load
from pebble.config.masking import values_of
from pebble.errors import PebbleError
from pebble.extensions.fleet.database import require_plain
from pebble.extensions.fleet.folder import FLEET
from pebble.extensions.operator.places import Places
from pebble.extensions.page.setting import people_of
from pebble.extensions.recordings.config import Recorder
from pebble.extensions.scripts.config import AutonomyManager
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner
from pebble.services.soundboard_handler.config import SoundboardHandler
from pebble.version import __version__

FORMAT = 1
ABOUT = "backup.json"
NOTE = "It holds passwords and private keys: who has this file can act as this robot, its broker and its page."
_SQLITE = b"SQLite format 3\0"
#: Ends of names: what SQLite has beside a database, recordings, halves of files, and what a broker makes again.
_NEVER_SAVED = ("-wal", "-shm", ".mcap", ".new", ".pid", ".pyc", "/mosquitto.db")
_SHA256 = "PEBBLE.sha256"  # of the content, in the header of each file but the first
_LARGEST = 64 << 20  # bytes of one file
_MOST = 1 << 30  # bytes of a backup
_LONGEST_NAME = 255  # bytes, of all file systems
_END = 2 * tarfile.BLOCKSIZE  # bytes of zeros, at least
#: Keys of mosquitto's configuration that name a file of accounts, rules or keys.
_BROKER_FILES = re.compile(
    r"^\s*(?:password_file|acl_file|psk_file|cafile|certfile|keyfile|crlfile|plugin_opt_config_file)\s+(/.*\S)",
    re.MULTILINE,
)


class BackupError(PebbleError):
    """An error: a backup cannot be made or read. Example: ``goob.tar: is no backup of Pebble``."""


class About(msgspec.Struct, frozen=True, kw_only=True):
    """The content of ``backup.json``. ``id``: the robot's; ``version``: of the Pebble that made it."""

    format: int
    version: str
    id: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Saved:
    """A file with its permissions."""

    content: bytes
    mode: int


@dataclass(slots=True)
class Backup:
    """A backup: ``files`` by their paths below the root; ``left_out``: why a file of the robot's is not in it."""

    about: About
    files: dict[str, Saved] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        return sum(len(saved.content) for saved in self.files.values())


# -- making one


def make(places: Places) -> Backup:
    """Return a backup of all files of the installed robot. Raises BackupError. The database may be in use."""
    if not places.config.is_file():
        raise BackupError(f"there is no {places.config}: no robot is installed there, so there is nothing to back up")
    config = load(places.config, {**os.environ, "STATE_DIRECTORY": str(places.state)})
    backup = Backup(About(format=FORMAT, version=__version__, id=config.robot.id, note=NOTE))
    files = dict.fromkeys(_files(places, config))
    plain = {file.resolve() for file in files if not file.is_symlink()}
    room = _MOST
    for file in files:
        if file.is_symlink() and file.resolve() in plain:
            continue  # setup makes such a link again
        with as_owner(file.parent):
            room -= _add(backup, places.root, file)
        if room < 0:  # before more is read: the robot needs its memory
            raise BackupError(f"it would have more than {_MOST / 1e9:.1f} GB: is there something below {places.state}?")
    for what, folder in _left_out(config):
        if (place := _here(places, folder)).exists():
            backup.left_out[str(place)] = what
    return backup


def _files(places: Places, config: Config) -> Iterator[Path]:
    """Yield the files that cannot be made again, also those in other places that are named in the config files."""
    without = [_here(places, folder) for _, folder in _left_out(config)]
    for folder in (places.etc, places.state, _here(places, config.state_dir())):
        yield from _below(folder, without)
    owner_extensions = (config.folder / name for name in config.extensions if name.endswith(".py"))
    named = [places.broker, people_of(config), *values_of(config, Path), *owner_extensions]
    if places.broker.is_file():
        named += map(Path, _BROKER_FILES.findall(places.broker.read_text(encoding="utf-8", errors="replace")))
    for path in named:
        file = _here(places, path)
        if (file.parent / FLEET).is_file():  # the accounts of a broker are one folder, with the authority's key
            yield from _below(file.parent, without)
        if file.is_file():
            yield file


def _here(places: Places, path: Path) -> Path:
    """Return the path of a robot's file below the root."""
    path = Path(os.path.normpath(path.absolute()))  # a config may name it by ../..
    return path if path.is_relative_to(places.root) else places.root / path.relative_to("/")


def _left_out(config: Config) -> Iterator[tuple[str, Path]]:
    """Yield the folders that no backup has, each after a word for its content."""
    yield "recordings", config.section(Recorder).place
    scripts = config.folder / config.section(AutonomyManager).autonomy_root
    if not scripts.is_relative_to(config.folder):
        yield "scripts of your own", scripts
    if (sounds := config.section(SoundboardHandler).playback.directory) is not None:
        yield "sounds", sounds


def _below(place: Path, without: Iterable[Path]) -> Iterator[Path]:
    """Yield the files below a folder, except for those in the folders ``without``."""
    for path in sorted(place.rglob("*")):
        if path.is_file() and not any(path.is_relative_to(folder) for folder in without):
            yield path


def _add(backup: Backup, root: Path, file: Path) -> int:
    """Add a file as it is at one moment, and return its size; 0 if it is left out."""
    name = str(file.relative_to(root))
    if name.endswith(_NEVER_SAVED):
        return 0
    try:
        if (size := file.stat().st_size) > _LARGEST:
            backup.left_out[str(file)] = f"{size / 1e6:.0f} MB are too large"
            return 0
        content = read_plain(file)
        if content.startswith(_SQLITE):  # these bytes may be of several moments
            content = _database(file)
        backup.files[name] = Saved(content, file.stat().st_mode & 0o777)
        return len(content)
    except FileNotFoundError:  # removed meanwhile
        return 0
    except OSError as error:
        raise BackupError(
            f"{file}: cannot be read: {error.strerror}; run it as root, or remove it if it is a link"
        ) from None


def _database(file: Path) -> bytes:
    """Return a consistent copy of a database, by SQLite's backup. Raises BackupError if it is damaged, or OSError."""
    require_plain(file)
    try:
        with (
            closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as original,
            closing(sqlite3.connect(":memory:")) as copy,
        ):
            original.backup(copy)
            ((result,),) = copy.execute("PRAGMA quick_check(1)").fetchall()
            if result != "ok":
                raise BackupError(f"{file}: is damaged: {result}")
            return copy.serialize()
    except sqlite3.Error as error:
        raise BackupError(f"{file}: is no whole database: {error}") from None


def packed(backup: Backup) -> bytes:
    """Return the backup as a tar file."""
    output = io.BytesIO()
    about = Saved(msgspec.json.format(msgspec.json.encode(backup.about)) + b"\n", 0o600)
    with tarfile.open(None, "w", output, format=tarfile.PAX_FORMAT) as tar:
        for name, saved in {ABOUT: about, **dict(sorted(backup.files.items()))}.items():
            member = tarfile.TarInfo(name)
            member.size, member.mode, member.mtime = len(saved.content), saved.mode, int(time.time())
            member.pax_headers = {} if name == ABOUT else {_SHA256: hashlib.sha256(saved.content).hexdigest()}
            tar.addfile(member, io.BytesIO(saved.content))
    return output.getvalue()


# -- reading one


def read(file: Path) -> Backup:
    """Return the backup in a file, complete and checked. Raises BackupError with one line."""
    try:
        return unpacked(read_plain(file, _MOST + _LARGEST), str(file))
    except OSError as error:
        raise BackupError(f"{file}: {error.strerror}") from None


def unpacked(raw: bytes, name: str) -> Backup:
    """Return the backup in ``raw``, the content of the file called ``name``."""
    try:
        with tarfile.open(fileobj=io.BytesIO(raw), mode="r:") as tar:
            members = iter(tar)
            backup = Backup(_about(tar, next(members, None), name))
            for member in members:
                path = _path(member, backup, name)
                backup.files[path] = Saved(_content(tar, member), member.mode & 0o777)
            rest = raw[tar.offset :]
            if len(rest) < _END or rest.strip(b"\0"):  # tarfile takes a damaged header for the end
                raise EOFError("its end is missing")
    except (tarfile.TarError, EOFError, ValueError) as error:
        if not raw.startswith(ABOUT.encode()):  # a tar file begins with the name of its first member
            raise BackupError(f"{name}: is no backup of Pebble") from None
        raise BackupError(f"{name}: is cut off or damaged: {error}; make another backup, or use an older one") from None
    return backup


def _about(tar: tarfile.TarFile, member: tarfile.TarInfo | None, name: str) -> About:
    if member is None or member.name != ABOUT or not member.isfile():
        raise BackupError(f"{name}: is no backup of Pebble: it does not begin with {ABOUT}")
    try:
        about = msgspec.json.decode(_content(tar, member), type=About)
    except msgspec.MsgspecError as error:
        raise BackupError(f"{name}: its {ABOUT} is not of a backup: {error}") from None
    if about.format != FORMAT:
        raise BackupError(f"{name}: has format {about.format}, of Pebble {about.version}: update Pebble here first")
    return about


def _path(member: tarfile.TarInfo, backup: Backup, name: str) -> str:
    """Return the path of a tar member; it cannot lead outside the root."""
    path = PurePosixPath(member.name)
    if (
        not member.isfile()
        or member.issparse()  # a few bytes may stand for a whole memory
        or path.is_absolute()
        or ".." in path.parts
        or str(path) != member.name
        or "\0" in member.name
        or any(len(os.fsencode(part)) > _LONGEST_NAME for part in path.parts)
    ):
        raise BackupError(f"{name}: {member.name!r} is not what a backup has: it was changed, or is of another program")
    if member.name in backup.files:
        raise BackupError(f"{name}: {member.name!r} is in it twice: it was changed")
    return member.name


def _content(tar: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    """Return the content of a member. Raises EOFError if it is cut off or has changed."""
    opened = tar.extractfile(member)
    content = b"" if opened is None else opened.read()
    digest = hashlib.sha256(content).hexdigest()
    if len(content) != member.size or member.pax_headers.get(_SHA256, digest) != digest:  # ABOUT, the first, has none
        raise EOFError(f"{member.name} is not what it was")
    return content
