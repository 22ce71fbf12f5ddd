"""The machine that setup changes: its files with their owners, and its programs."""

import grp
import os
import pwd
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pebble.errors import PebbleError
from pebble.extensions.checks.program import run
from pebble.extensions.operator.places import Places
from pebble.runtime.as_owner import as_owner
from pebble.runtime.whole_file import is_root, write

ROBOTS = "root:pebble"  # what the robot reads, and only root changes
ROBOT = "pebble:pebble"
MOSQUITTO = "mosquitto:mosquitto"
_COMMAND_S = 120.0
_PACKAGES = {"pebble": "./pebble-robot_….deb", "mosquitto": "mosquitto"}


class SetupError(PebbleError):
    """An error: a machine cannot be set up as asked. Example: ``only root can do this: sudo pebble setup``."""


def run_command(command: Sequence[str]) -> None:
    """Run a program of the machine. Raises SetupError with the first line of its error output."""
    line = " ".join(command)
    try:
        done = run(command, _COMMAND_S)
    except OSError as error:
        raise SetupError(f"`{line}`: {error.strerror}") from None
    except subprocess.TimeoutExpired:
        raise SetupError(f"`{line}` did not end within {_COMMAND_S:g} s") from None
    if done.code != 0:
        complaint = (done.errors.strip() or done.output.strip() or "it failed").splitlines()[0]
        raise SetupError(f"`{line}`: {complaint}")


def owner_of(names: str) -> tuple[int, int]:
    """Return the ids of ``user:group``, which Debian packages have created. Raises SetupError."""
    if not is_root():
        raise SetupError("only root can do this: sudo pebble setup")
    user, _, group = names.partition(":")
    try:
        return pwd.getpwnam(user).pw_uid, grp.getgrnam(group).gr_gid
    except KeyError:
        package = _PACKAGES.get(group, group)
        raise SetupError(f"there is no user {group}: sudo apt install {package}, then sudo pebble setup") from None


@dataclass(frozen=True)
class System:
    """A machine. Tests give it another root, and replace running programs and changing owners."""

    places: Places = field(default_factory=Places)
    run: Callable[[Sequence[str]], None] = run_command
    owner: Callable[[str], tuple[int, int] | None] = owner_of

    @property
    def has_systemd(self) -> bool:
        return (self.places.root / "run/systemd/system").is_dir()

    def write(self, file: Path, content: bytes, mode: int = 0o640, owner: str = ROBOTS) -> None:
        """Replace a file in one step. Raises SetupError."""
        ids = self.owner(owner)
        with as_owner(file.parent):
            write(file, content, mode, SetupError, ids if is_root() else None)

    def make_folder(self, folder: Path, mode: int, owner: str, fill: Callable[[Path], None] | None = None) -> None:
        """Create a folder with its files in one step: it exists completely or not at all. Raises SetupError."""
        ids = self.owner(owner)
        new = folder.with_name(f".{folder.name}.new")
        try:
            with as_owner(folder.parent):
                shutil.rmtree(new, ignore_errors=True)
                new.mkdir(mode=0o700)
                if fill is not None:
                    fill(new)
                new.chmod(mode)
                if ids is not None and is_root():  # last of all: from then on the owner may change what is in it
                    for path in (*new.iterdir(), new):
                        os.chown(path, *ids, follow_symlinks=False)
                new.rename(folder)
        except OSError as error:
            raise SetupError(f"{folder}: {error.strerror}") from None
