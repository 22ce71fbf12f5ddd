"""Where an installed robot has its files, below ``/`` or below another root."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path


@dataclass(frozen=True)
class Places:
    """The paths of an installed robot. ``root`` is ``/``, or a folder that stands for it in tests and dry runs."""

    root: Path = Path("/")

    @property
    def is_live(self) -> bool:
        """Whether it is the system that runs, of which services can be started."""
        return self.root == Path("/")

    @cached_property
    def etc(self) -> Path:
        """Config, passwords, certificates and the manifest: ``root:pebble``, files 0640."""
        return self.root / "etc/pebble"

    @cached_property
    def config(self) -> Path:
        return self.etc / "robot.json"

    @cached_property
    def manifest(self) -> Path:
        """What ``pebble setup`` was answered, and the SHA-256 of each file that it wrote."""
        return self.etc / "setup.json"

    @cached_property
    def state(self) -> Path:
        """What survives a power cut, the stop among it: ``pebble:pebble``, 0700. ``$STATE_DIRECTORY`` of the unit."""
        return self.root / "var/lib/pebble"

    @cached_property
    def slots(self) -> Path:
        """``a`` and ``b``, each a virtual environment, and the link ``active``."""
        return self.root / "opt/pebble"

    @cached_property
    def slot_state(self) -> Path:
        """``trial``, ``refused`` and ``sequence``: of ``pebble-slot`` and of updates."""
        return self.root / "var/lib/pebble-update"

    @cached_property
    def current_slot(self) -> Path:
        """The link that ``pebble-slot choose`` sets at each start; the unit runs what it points to."""
        return self.root / "run/pebble-slot/current"

    @cached_property
    def broker(self) -> Path:
        """The part of mosquitto's configuration that is ours."""
        return self.root / "etc/mosquitto/conf.d/pebble.conf"

    @cached_property
    def broker_folder(self) -> Path:
        """Accounts, rules and certificate of the robot's own broker: a folder of `pebble fleet`."""
        return self.root / "etc/mosquitto/pebble"

    @cached_property
    def tls(self) -> Path:
        """The certificate of the robot's page, and its authority."""
        return self.etc / "tls"

    @cached_property
    def people(self) -> Path:
        """Who may use the robot's page. It keeps its name when the robot gets another."""
        return self.state / "people.sqlite"

    def named(self, path: Path) -> str:
        """The path as it is on the machine whose root this is."""
        return f"/{path.relative_to(self.root)}"
