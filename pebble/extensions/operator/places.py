"""The paths of an installed robot's files, and of the machine's mosquitto; and whether a robot runs here."""

import os
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pebble.config import LAUNCHER_LOCK
from pebble.ownership import read_plain

SBIN = "/usr/local/sbin:/usr/sbin:/sbin"  # where Debian puts brokers and network tools, not in the PATH of users


@dataclass(frozen=True)
class Places:
    """The paths of an installed robot. ``root`` is ``/``, or another folder in tests and reports."""

    root: Path = Path("/")

    @cached_property
    def etc(self) -> Path:
        """Folder of config, passwords and certificates: ``root:pebble``, files 0640."""
        return self.root / "etc/pebble"

    @cached_property
    def config(self) -> Path:
        return self.etc / "robot.json"

    @cached_property
    def unfinished(self) -> Path:
        """A file that marks an unfinished setup: services do not use its files yet. No backup has it."""
        return self.etc / "setup.new"

    @cached_property
    def state(self) -> Path:
        """Folder of the stop and all that survives a power cut: ``pebble:pebble``, 0700; ``$STATE_DIRECTORY``."""
        return self.root / "var/lib/pebble"

    @cached_property
    def slots(self) -> Path:
        """Folder of ``a`` and ``b``, each a virtual environment, and of the link ``active``."""
        return self.root / "opt/pebble"

    @cached_property
    def slot_state(self) -> Path:
        """Folder of what ``pebble-slot`` notes of updates: one on trial, one that was refused, the newest installed."""
        return self.root / "var/lib/pebble-update"

    @cached_property
    def current_slot(self) -> Path:
        """Link that ``pebble-slot choose`` sets at each start; the unit runs the slot to which it points."""
        return self.root / "run/pebble-slot/current"

    @cached_property
    def broker(self) -> Path:
        """Our part of mosquitto's configuration."""
        return self.root / "etc/mosquitto/conf.d/pebble.conf"

    @cached_property
    def broker_folder(self) -> Path:
        """Folder of the robot's own broker, as of `pebble fleet`: accounts, rules and certificate."""
        return self.root / "etc/mosquitto/pebble"

    @cached_property
    def tls(self) -> Path:
        """The certificate of the robot's page, and its authority."""
        return self.etc / "tls"

    @cached_property
    def people(self) -> Path:
        """File with the users of the robot's page. It keeps its name when the robot gets another."""
        return self.state / "people.sqlite"

    def named(self, path: Path) -> str:
        """Return the path without this root, as programs on the machine name it."""
        return f"/{path.relative_to(self.root)}"


def mosquitto_path() -> str | None:
    """Return the path of mosquitto; None if it is not installed."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path=SBIN)


def launcher_runs(run_dir: Path) -> bool:
    """True if the last started launcher of this run directory is still running."""
    try:
        pid = int(read_plain(run_dir / LAUNCHER_LOCK).partition(b"\n")[0])
        os.kill(pid, 0)
    except (OSError, ValueError, OverflowError):
        return False
    return True
