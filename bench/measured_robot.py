"""A whole robot that is launched separately, and whose processes are known by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pebble.bench.bridge_robot import KINDS, RobotProcesses
from pebble.bench.usage import children
from pebble.config import load
from pebble.errors import PebbleError
from pebble.launcher.programs import programs

LAUNCHER, BROKER = "launcher", "mosquitto"
CAMERA_WIDTH, CAMERA_HEIGHT, CAMERA_FPS = 640, 480, 15
_COMM_BYTES = 15  # of a process's name in the kernel


class MeasuredRobot(RobotProcesses):
    """``with`` starts the robot's environment, :meth:`launch` the robot.

    ``kind`` is its local transport. With ``media`` it has a camera and a microphone.
    """

    def __init__(self, kind: str, *, media: bool = False) -> None:
        super().__init__(kind, media=media, launched=False)
        self.kind = kind

    @property
    def config(self) -> Path:
        return self._root / "robot.json"

    def processes(self) -> dict[str, int]:
        """The robot's processes by name: its launcher, the launcher's children, and the local broker."""
        if self._launcher is None:
            return {}
        names = {name[:_COMM_BYTES]: name for name in self._programs_of()}
        found = {LAUNCHER: self._launcher.pid}
        for pid in children(self._launcher.pid):
            comm = _comm(pid)
            if comm:
                found[names.get(comm, comm)] = pid
        if self.kind == "mqtt":
            found[BROKER] = self._brokers["local"].program.pid
        return found

    def complete(self) -> bool:
        """Whether all its programs run, including those started on demand."""
        return self._programs_of() <= self.processes().keys()

    def expect(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        """Waits for the condition. Raises PebbleError with the robot's log after ``timeout`` seconds, or if it ends."""
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
    """A process's name in the kernel; empty if it has just ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def check_kinds(kinds: Sequence[str], *, also: Sequence[str] = ()) -> None:
    """Raises PebbleError naming an unknown or repeated transport. ``also`` may be named besides ours."""
    known = (*KINDS, *also)
    unknown = [kind for kind in kinds if kind not in known]
    if unknown or not kinds:
        raise PebbleError(f"unknown transport {', '.join(unknown)}: there are {', '.join(known)}")
    if len(set(kinds)) < len(kinds):
        raise PebbleError(f"{', '.join(kinds)}: name each transport once")
