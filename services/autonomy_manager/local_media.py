"""Where programs of the original find pictures, sound and hall samples on a robot, and whether they are there."""

from pathlib import Path
from typing import Any

from pebble.config import Config
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.services.autonomy_manager.needs import CALIBRATION, HALL_OPTION, Needs

_SOCKETS = {"video": Path("/tmp/pebble-video.sock"), "audio": Path("/tmp/pebble-audio.sock")}  # noqa: S108 - theirs
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where Linux has it
_LISTENING = Path("/proc/net/unix")


class LocalMedia:
    """What a robot's config offers to programs of the original."""

    def __init__(self, config: Config, unix_sockets: Path = _LISTENING, memory: Path = _SHARED_MEMORY) -> None:
        self._config, self._unix_sockets, self._memory = config, unix_sockets, memory
        devices = config.services.av_daemon
        self._sections: dict[str, Any] = {"video": devices.video, "audio": devices.audio}
        lines = config.serial_instances().values()
        self._rings = [line.odometry_shm for line in lines if SERIAL_PROTOCOLS[line.protocol].drives]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the camera's pictures."""
        video = self._config.services.av_daemon.video
        return video.width, video.height

    @property
    def hall_name(self) -> str:
        """The shared memory of hall samples."""
        return next((ring.name for ring in self._rings if ring and ring.name), self._own_name).lstrip("/")

    @property
    def _own_name(self) -> str:
        return f"{self._config.base.replace('/', '_')}_odometry_raw"

    @property
    def hall_options(self) -> tuple[str, ...]:
        """The original's `wheel-odometry` does not read a name from the config."""
        return () if self.hall_name == self._own_name else (HALL_OPTION, self.hall_name)

    def lacks(self, needs: Needs, folder: Path, working: Path) -> str:
        """Why a script with these needs never gets what it waits for; empty: it may."""
        for section, needed, what in (("video", needs.pictures, "pictures"), ("audio", needs.sound, "sound")):
            if needed and (why := self._no_socket(section, what)):
                return why
        if needs.hall and not any(ring and ring.enabled for ring in self._rings) and not self._has_hall():
            return "it reads hall samples from shared memory: set services.serial_mcu_bridge.odometry_shm"
        places = (working, folder, self._config.folder)
        if needs.calibration and not any((place / CALIBRATION).is_file() for place in places):
            return f"there is no {CALIBRATION} beside the script or the config: docs/from-the-original.md"
        return ""

    def absent(self, needs: Needs) -> str:
        """What is not there now; empty: all that is known of."""
        for section, needed, what in (("video", needs.pictures, "pictures"), ("audio", needs.sound, "sound")):
            path = self._socket(section)
            if needed and not self._listens(path):
                return f"{what} at {path}, where nobody offers any"
        if needs.hall and not self._has_hall():
            return f"hall samples in shared memory {self.hall_name}"
        return ""

    def _no_socket(self, section: str, what: str) -> str:
        devices = self._config.services.av_daemon
        if self._listens(self._socket(section)):
            return ""
        if not devices.enabled or not self._sections[section].enabled:
            return f"it reads {what}, and services.av_daemon.{section} is not enabled"
        if self._sections[section].socket_path is None:
            return f"it reads {what} at a GStreamer socket: set services.av_daemon.{section}.socket_path"
        return ""

    def _socket(self, section: str) -> Path:
        return Path(self._sections[section].socket_path or _SOCKETS[section])

    def _listens(self, path: Path) -> bool:
        """Whether a process listens there. To connect would switch the camera on."""
        try:
            lines = self._unix_sockets.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return path.exists()
        return any(line.endswith(f" {path}") and line.split()[3] == "00010000" for line in lines)

    def _has_hall(self) -> bool:
        return (self._memory / self.hall_name).exists()
