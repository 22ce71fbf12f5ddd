"""A whole robot that is started when its measurer is ready, and whose processes are known by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pebble.bench.bridge_robot import KINDS, Robot
from pebble.bench.usage import children
from pebble.config import load
from pebble.errors import PebbleError
from pebble.launcher.programs import programs

LAUNCHER, BROKER = "launcher", "mosquitto"
CAMERA_WIDTH, CAMERA_HEIGHT, CAMERA_FPS = 640, 480, 15
_COMM_BYTES = 15  # of a process's name that the kernel knows


class MeasuredRobot(Robot):
    """``with`` starts everything around it, :meth:`launch` the robot itself.

    ``kind`` is its transport. With ``media`` it has a camera and a microphone.
    """

    def __init__(self, kind: str, *, media: bool = False) -> None:
        super().__init__(kind, media=media, launched=False)
        self.kind = kind

    @property
    def config(self) -> Path:
        return self._root / "robot.json"

    def processes(self) -> dict[str, int]:
        """All that belongs to the robot, by name: its launcher, the launcher's children, and the broker on it."""
        if self._launcher is None:
            return {}
        names = {name[:_COMM_BYTES]: name for name in self._programs_of()}
        found = {LAUNCHER: self._launcher.pid}
        for pid in children(self._launcher.pid):
            said = _comm(pid)
            if said:
                found[names.get(said, said)] = pid
        if self.kind == "mqtt":
            found[BROKER] = self._brokers[1].program.pid
        return found

    def complete(self) -> bool:
        """All its programs run, those on demand too."""
        return self._programs_of() <= self.processes().keys()

    def expect(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        """Wait until it is so. Raises PebbleError with the robot's last words if it does not come, or it ends."""
        if self._launcher is None:
            raise PebbleError("the robot was not launched")
        try:
            self._launcher.wait_until(condition, timeout, self._never)
        except PebbleError as error:
            raise PebbleError(f"{what}: {error}\n{self.log()}") from None

    def _programs_of(self) -> set[str]:
        return {program.name for program in programs(load(self.config))}

    def _config(self, port: Path) -> dict[str, Any]:
        config = super()._config(port)
        if self._media:
            size = {"width": CAMERA_WIDTH, "height": CAMERA_HEIGHT, "fps": CAMERA_FPS}
            config["services"]["av_daemon"]["video"] = {"backend": "synthetic", **size}
            config["services"]["mqtt_bridge"]["media"] = {
                "video_publisher": {f"publish_{name}": value for name, value in size.items()}
            }
        return config


def _comm(pid: int) -> str:
    """Empty for a process that has just ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def check_kinds(kinds: Sequence[str]) -> None:
    """Raises PebbleError naming what is no transport of a robot, or is there twice."""
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise PebbleError(f"unknown transport {', '.join(unknown)}: there are {', '.join(KINDS)}")
    if len(set(kinds)) < len(kinds):
        raise PebbleError(f"{', '.join(kinds)}: name each transport once")
