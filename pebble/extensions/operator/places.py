"""The paths of an installed robot's files, and of the machine's mosquitto; and whether a robot runs here."""

import os
import shutil
from pathlib import Path

from pebble.config import LAUNCHER_LOCK
from pebble.ownership import read_plain

SBIN = "/usr/local/sbin:/usr/sbin:/sbin"  # where Debian puts brokers and network tools, not in the PATH of users


class Places:
    """The paths of an installed robot. ``root`` is ``/``, or another folder in tests and reports."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root
        #: Folder of config, passwords and certificates: ``root:pebble``, files 0640.
        self.etc = root / "etc/pebble"
        self.config = self.etc / "robot.json"
        #: A file that marks an unfinished setup: services do not use its files yet. No backup has it.
        self.unfinished = self.etc / "setup.new"
        #: The certificate of the robot's page, and its authority.
        self.tls = self.etc / "tls"
        #: Folder of the stop and all that survives a power cut: ``pebble:pebble``, 0700; ``$STATE_DIRECTORY``.
        self.state = root / "var/lib/pebble"
        #: File with the users of the robot's page. It keeps its name when the robot gets another.
        self.people = self.state / "people.sqlite"
        #: Folder of ``a`` and ``b``, each a virtual environment, and of the link ``active``.
        self.slots = root / "opt/pebble"
        #: Folder of what ``pebble-slot`` notes of updates: one on trial, one that was refused, the newest installed.
        self.slot_state = root / "var/lib/pebble-update"
        #: Link that ``pebble-slot choose`` sets at each start; the unit runs the slot to which it points.
        self.current_slot = root / "run/pebble-slot/current"
        #: Our part of mosquitto's configuration.
        self.broker = root / "etc/mosquitto/conf.d/pebble.conf"
        #: Folder of the robot's own broker, as of `pebble fleet`: accounts, rules and certificate.
        self.broker_folder = root / "etc/mosquitto/pebble"

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
