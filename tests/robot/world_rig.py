"""Whole robots in a simulated world: it has their motor MCUs and knows where they are; their own cameras see it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pebble.extensions.lab.simulation.loudspeaker import Playback, playbacks
from pebble.extensions.lab.simulation.world.pose_page import PoseReader, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose
from pebble.extensions.lab.simulation.world.program import port_path, trace_path
from tests.robot.rig import Motors, Rig
from tests.support import ROOT, Child, until

SCRIPTS, PEBBLES_SCRIPTS = Path(__file__).parent / "scripts", ROOT / "pebble/extensions/scripts/shipped"
TAG, TAG_SIZE_M = 13, 0.25
#: One robot in a large room with one tag, 2 m ahead of the middle.
ROOM: dict[str, Any] = {
    "room": {"x_min": -4.0, "x_max": 4.0, "y_min": -4.0, "y_max": 4.0},
    "tags": [{"id": TAG, "x": 2.0, "y": 0.0, "yaw_deg": 180.0, "size_m": TAG_SIZE_M}],
    "robots": {"goob": {"x": 0.0, "y": 0.0}},
}
STOP_TIMEOUT_S = 2.0
FOLLOW = {"tag_id": TAG, "tag_size_m": TAG_SIZE_M}


class World:
    """The process of a world."""

    def __init__(self, layout: dict[str, Any] | None = None) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="pblw")
        self.folder = folder = Path(self._temporary.name)
        self.path, self.layout = folder / "world.json", layout or ROOM
        self.path.write_text(json.dumps(self.layout))
        self._process = Child(
            [sys.executable, "-m", "pebble.cli", "sim", "world", str(self.path), "--folder", str(folder),
             "--trace", str(folder), "--report", "--control"],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        ports = [port_path(folder, name) for name in self.layout["robots"]]
        assert until(lambda: all(port.exists() for port in ports), 15), "the simulated world did not start"
        self._poses = PoseReader(page_path(self.path))
        assert until(lambda: len(self._poses.tracks()) == len(ports))

    @property
    def pid(self) -> int:
        return self._process.pid

    def motors(self, name: str) -> Motors:
        return Motors(port_path(self.folder, name), trace_path(self.folder, name))

    def pose(self, name: str, at: float | None = None) -> RobotPose:
        """Where a robot is, or was ``at`` a monotonic time within the last second."""
        track = self._poses.tracks()[name]
        return track.newest.pose if at is None else track.at(round(at * 1e9))

    def tag_from(self, name: str, tag: int = TAG) -> tuple[float, float]:
        """Distance in metres and bearing in radians (positive to the left) of a tag from a robot's camera."""
        pose = self.pose(name)
        found = next(one for one in self.layout["tags"] if one["id"] == tag)
        dx, dy = found["x"] - pose.x, found["y"] - pose.y
        return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - pose.heading, math.tau)

    def place(self, name: str, x: float, y: float, degrees: float) -> None:
        """Put a robot there."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{name} place {x:.4f} {y:.4f} {degrees:.3f}\n".encode())
        self._process.stdin.flush()
        assert until(lambda: math.hypot(self.pose(name).x - x, self.pose(name).y - y) < 0.02)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10)
        self._temporary.cleanup()


class WorldRig(Rig):
    """A robot in a world: its camera, scripts (Pebble's and those of the tests) and a simulated loudspeaker.

    Without ``world`` it has one of its own. ``camera`` False: none, for what needs no pictures. ``pictures_socket``:
    programs of the original find its pictures. ``scripts``: their sections in the config. ``files``: which of the
    tests' scripts it has, as a pattern; it asks each what it is, by a process.
    """

    def __init__(
        self,
        kind: str,
        world: World | None = None,
        *,
        name: str = "goob",
        camera: bool = True,
        pictures_socket: bool = False,
        scripts: dict[str, Any] | None = None,
        files: str = "*",
        **more: Any,
    ) -> None:
        self._files = files
        self._own = None if world is not None else World()
        self.world = world or self._own
        self.sounds, self._record = (self.world.folder / f"{name}.{what}" for what in ("sounds", "played"))
        self.sounds.mkdir()
        (self.world.folder / "timing").touch()
        services = {
            "soundboard_handler": {"enabled": True, "playback": self._playback()},
            "autonomy_manager": {
                "enabled": True,
                "stop_timeout_seconds": STOP_TIMEOUT_S,
                "env": self._environment(),
                "scripts": scripts or {},
            },
            "av_daemon": {
                "enabled": camera,
                "video": self._video(name)
                | ({"socket_path": str(self.world.folder / f"{name}.sock")} if pictures_socket else {}),
                "audio": {"enabled": False},
            },
        }
        super().__init__(kind, name=name, motors=self.world.motors(name), direct=True, start=False, **(services | more))
        (self.folder / "autonomy").mkdir()
        for script in SCRIPTS.glob(files):
            (self.folder / "autonomy" / script.name).symlink_to(script)
        try:
            self.start()
        except BaseException:
            self.close()
            raise

    def wait_until_up(self, since: float, timeout: float = 15.0) -> None:
        super().wait_until_up(since, timeout)
        self.wait_for_scripts(since)

    def wait_for_scripts(self, since: float, timeout: float = 60.0) -> None:
        """A catalogue with all scripts, Pebble's and those of the tests, was published after ``since``."""
        places = ((SCRIPTS, self._files), (PEBBLES_SCRIPTS, "*"))
        wanted = {run.parent.name for folder, files in places for run in folder.glob(f"{files}/run.py")}
        assert until(lambda: wanted <= self._offered(since), timeout), f"only {self._offered(since)} of {wanted}"

    def close(self) -> None:
        super().close()
        if self._own is not None:
            self._own.close()

    # -- its scripts

    def run(self, file: str, config: dict[str, Any] | None = None) -> float:
        """Start a script; returns when the command was sent."""
        began = time.monotonic()
        self.operator.send("incoming/autonomy-command", {"action": "start", "file": file, "config": config or {}})
        return began

    def end(self) -> float:
        """Stop the script; returns when the command was sent."""
        began = time.monotonic()
        self.operator.send("incoming/autonomy-command", {"action": "stop"})
        return began

    def script(self) -> dict[str, Any]:
        """The newest ``autonomy-status``; empty before the first."""
        seen = self.operator.last("outgoing/autonomy-status")
        return {} if seen is None else seen.json

    def fresh_status(self, since: float) -> bool:
        """Was a status published after ``since``, and does no script run?"""
        seen = self.operator.last("outgoing/autonomy-status")
        return seen is not None and seen.at > since and not seen.json["running"]

    def driving(self, file: str, config: dict[str, Any] | None = None) -> int:
        """Start a script and wait until its commands turn the wheels; returns its process."""
        began = self.run(file, config)
        assert until(lambda: self.script().get("running") and self.mcu.moving(began), 15), self.log.read_text()[-3000:]
        return int(self.script()["pid"])

    def idle(self) -> None:
        """End the script, and wait until it has ended and the wheels stand."""
        self.end()
        assert until(lambda: not self.script().get("running") and not self.mcu.turning(), 15)

    def timings(self) -> list[tuple[float, float]]:
        """The times of ``timed-follow``: capture of a picture, and publication of the command that followed."""
        lines = (self.world.folder / "timing").read_text().splitlines()
        return [(int(captured) / 1e9, int(published) / 1e9) for captured, published in map(str.split, lines)]

    def played(self) -> list[Playback]:
        return playbacks(self._record)

    def _offered(self, since: float) -> set[str]:
        """The scripts in the catalogue that was published after ``since``."""
        seen = [seen for seen in self.operator.on("outgoing/autonomy-files", since) if not seen.retain]
        return {script["file"] for script in seen[-1].json["files"]} if seen else set()

    def _playback(self) -> dict[str, Any]:
        player = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self._record)]
        return {"directory": str(self.sounds), "player_command": player}

    def _environment(self) -> dict[str, str]:
        return {"TIMING": str(self.world.folder / "timing"), "PYTHONPATH": str(ROOT)}

    def _video(self, name: str) -> dict[str, Any]:
        return {"backend": "synthetic", "device": f"{self.world.path}#{name}", "width": 640, "height": 480, "fps": 15}
