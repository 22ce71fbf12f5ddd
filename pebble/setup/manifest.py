"""What ``pebble setup`` was answered and what it made, in ``/etc/pebble/setup.json``: by it all of it is undone."""

import hashlib
import os
import shutil
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct, field

from pebble.errors import PebbleError
from pebble.fleet.whole_file import write
from pebble.setup.places import Places

_CHANGING = "?"  # in place of a SHA-256: setup changes this file, whatever is in it then


class SetupError(PebbleError):
    """A machine cannot be set up as asked. Example: ``/etc/pebble/setup.json: Permission denied``."""


class Manifest(Struct, kw_only=True, forbid_unknown_fields=True):
    """``files``: by path below the root, the SHA-256 of each content that is ours; several while one is replaced.

    ``folders`` are those that setup made. ``ran``: commands, each with the SHA-256 of what it ran for. ``leaving``:
    earlier ids, of which retained messages may still be at the broker. ``restoring``: the SHA-256 of a backup.
    """

    format: Literal[1] = 1
    answers: dict[str, Any] = field(default_factory=dict)
    files: dict[str, list[str]] = field(default_factory=dict)
    folders: list[str] = field(default_factory=list)
    ran: dict[str, str] = field(default_factory=dict)
    leaving: list[str] = field(default_factory=list)
    restoring: str = ""

    def answer(self, answers: dict[str, Any], *, leaves: bool = True) -> None:
        """Take other answers. ``leaves``: an earlier name is no longer in use, as it is where a second robot begins."""
        earlier, name = self.answers.get("id"), answers.get("id")
        if leaves and earlier is not None and earlier not in self.leaving:
            self.leaving.append(earlier)
        if name in self.leaving:
            self.leaving.remove(name)
        self.answers = answers

    def is_ours(self, name: str, content: bytes) -> bool:
        known = self.files.get(name, [])
        return sha256(content) in known or _CHANGING in known

    def is_changing(self, name: str) -> bool:
        return _CHANGING in self.files.get(name, [])

    def intend(self, name: str, content: bytes | None) -> None:
        """Note what will be written there; None: what is not known yet."""
        digest = _CHANGING if content is None else sha256(content)
        self.files[name] = list(dict.fromkeys((*self.files.get(name, []), digest)))

    def wrote(self, name: str, content: bytes) -> None:
        self.files[name] = [sha256(content)]


def content_of(path: Path) -> bytes:
    """What is in a file, or where a link leads. Raises OSError."""
    return f"link to {path.readlink()}".encode() if path.is_symlink() else path.read_bytes()


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def load(places: Places) -> Manifest | None:
    """None: this machine has not been set up. Raises SetupError."""
    try:
        return decode(places.manifest.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SetupError(f"{places.manifest}: {error.strerror}: use sudo") from None
    except msgspec.MsgspecError as error:
        raise SetupError(f"{places.manifest}: {error}") from None


def decode(text: bytes) -> Manifest:
    """Raises MsgspecError."""
    return msgspec.json.decode(text, type=Manifest)


def save(places: Places, manifest: Manifest, owner: tuple[int, int] | None) -> None:
    """Write it, and its folder with it if there is none: without a manifest nothing there would be ours."""
    if not places.etc.is_dir():
        own = places.named(places.etc)
        manifest.folders = [own, *(name for name in manifest.folders if name != own)]
    ordered = {name: manifest.files[name] for name in sorted(manifest.files)}
    text = msgspec.json.format(msgspec.json.encode(msgspec.structs.replace(manifest, files=ordered)), indent=1) + b"\n"
    if places.etc.is_dir():
        write(places.manifest, text, 0o600, SetupError)
        return
    new = places.etc.with_name(f".{places.etc.name}.new")
    name = places.manifest.name
    try:
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        write(new / name, text, 0o600, SetupError)
        finish_folder(new, 0o750, owner)
        new.rename(places.etc)
    except OSError as error:
        raise SetupError(f"{places.etc}: {error.strerror}") from None


def finish_folder(folder: Path, mode: int, owner: tuple[int, int] | None) -> None:
    """Give a new folder its owner and mode. Raises OSError."""
    if owner is not None:
        os.chown(folder, *owner)
    folder.chmod(mode)
