"""The partners of the bridge: scripted ones always, and Debian's rosmaster and rospy in `make long PART=ros1`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.services.ros1_bridge.service import Ros1Bridge
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import Listener, Running
from tests.support import Child, free_port, listening, until

HERE = Path(__file__).parent
NEEDED = "rosmaster, rospy, nav_msgs.msg, diagnostic_msgs.msg, actionlib_msgs.msg, geometry_msgs.msg, std_msgs.msg"
DEBIAN = (
    subprocess.run(["/usr/bin/python3", "-c", f"import {NEEDED}"], capture_output=True, check=False).returncode == 0
)
ROSMASTER = "import rosmaster; rosmaster.rosmaster_main(['rosmaster', '--core', '-p', '{}'])"

Row = tuple[int, str, list[str]]  # nanoseconds, kind, words


class World:
    """A master at ``uri``, and bases that write what they hear into one log."""

    def __init__(self, folder: Path, partner: str) -> None:
        self.partner, self.log, self.ends = partner, folder / "base.log", ExitStack()
        self.log.touch()
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {**os.environ, "ROS_MASTER_URI": self.uri, "ROS_IP": "127.0.0.1",
                            "ROS_LOG_DIR": str(folder), "ROS_HOME": str(folder), "PYTHONPATH": ""}  # fmt: skip
        self.processes: dict[str, Child] = {}

    def start(self, name: str, *command: str) -> Child:
        python = [sys.executable] if self.partner == "scripted" else ["/usr/bin/python3"]
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = self.processes[name] = Child([*python, *command], env=self.environment, **quiet)
        self.ends.callback(process.wait)
        self.ends.callback(process.kill)
        return process

    def start_master(self) -> None:
        real = ("-c", ROSMASTER.format(self.port))
        self.start(
            "master", *(real if self.partner == "debian" else (str(HERE / "scripted.py"), "master", str(self.port)))
        )
        assert until(lambda: listening(self.port))

    def start_base(self) -> int:
        """Start a base; returns when it was up, in nanoseconds of the monotonic clock."""
        begin = time.monotonic_ns()
        program = "rospy_base.py" if self.partner == "debian" else "scripted.py"
        self.start("base", str(HERE / program), "base", "husky_base", self.uri, str(self.log))
        assert until(lambda: self.rows(begin, "up"))
        return self.rows(begin, "up")[0][0]

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        self.processes[name].send_signal(number)
        if number == signal.SIGKILL:
            self.processes[name].wait()

    def do(self, line: str) -> None:
        """Have the base do something, and wait until it does."""
        path = Path(f"{self.log}.do")
        path.with_suffix(".new").write_text(line)
        path.with_suffix(".new").rename(path)
        assert until(lambda: not path.exists())

    def rows(self, since: int = 0, kind: str = "cmd") -> list[Row]:
        """Return what the base has noted since then."""
        lines = (line.split() for line in self.log.read_text().splitlines())
        return [(int(at), what, words) for at, what, *words in lines if int(at) >= since and what == kind]

    def moves(self, since: int = 0) -> list[Row]:
        return [row for row in self.rows(since) if float(row[2][0]) or float(row[2][1])]

    def zeros(self, since: int = 0) -> list[Row]:
        return [row for row in self.rows(since) if not (float(row[2][0]) or float(row[2][1]))]

    def locks(self, since: int = 0) -> list[str]:
        """Return what the lock was set to."""
        return [words[0] for _, _, words in self.rows(since, "estop")]


class Husky:
    """A robot with the bridge, on a thread of this process; ``world`` is its operator."""

    def __init__(self, ros: World, folder: Path, /, **section: Any) -> None:
        self.ros, self.folder, self.section, self.hub = ros, folder, section, MemoryHub()
        self.world = Listener(MemoryTransport("operator", self.hub), "pebble/robots/husky")
        self.config = self.read()

    def read(self) -> Config:
        ros = {"master_uri": self.ros.uri, "host": "127.0.0.1", **self.section.get("ros", {})}
        section = {"enabled": True, **self.section, "ros": ros}
        raw = {
            "robot": {"id": "husky"},
            "services": {"ros1_bridge": section},
            "transport": {"kind": "mqtt", "run_dir": str(self.folder / "run"), "state_dir": str(self.folder / "state")},
        }
        return parse(raw, folder=self.folder, env={})

    def start(self) -> Husky:
        self.bridge = Ros1Bridge(self.config, MemoryTransport("ros1", self.hub))
        self.running = Running(self.bridge)
        return self

    def ready(self) -> Husky:
        """Start, and wait until the base hears it, and has heard its first zero, and is heard."""
        heard = len(self.ros.rows())
        self.start()
        assert until(lambda: self.bridge.assess() == ("ready", 0, "")), self.bridge.assess()
        assert until(lambda: len(self.ros.rows()) > heard)
        return self

    def send(self, **drive: Any) -> int:
        self.world.command("drive-values", drive)
        return time.monotonic_ns()

    def drive(self, seconds: float, z: float = 0.5) -> int:
        """Drive as a page does; returns when the last command was sent."""
        end, last = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            last = self.send(x=0.0, z=z)
            time.sleep(0.05)
        return last

    def is_obeyed(self) -> bool:
        """Drive until the base moves."""
        begin = time.monotonic_ns()
        return until(lambda: self.drive(0.1) and self.ros.moves(begin))

    def stop_it(self) -> None:
        self.world.command("estop", {"by": "ann"})
        assert self.world.became("estop/ros1", latched=True)

    def reset(self) -> None:
        state = self.world.newest("estop/ros1")
        self.world.command("estop-reset", {"boot": state["boot"], "count": state["count"]})
        assert self.world.became("estop/ros1", latched=False)

    def end(self) -> None:
        self.running.stop()


DEBIAN_ONLY = [
    pytest.mark.skipif(not os.environ.get("PEBBLE_THOROUGH"), reason="make long PART=ros1"),
    pytest.mark.skipif(not DEBIAN, reason=f"/usr/bin/python3 cannot import {NEEDED}"),
]


@pytest.fixture(params=["scripted", pytest.param("debian", marks=DEBIAN_ONLY)])
def ros(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[World]:
    """A master and a base."""
    world = World(tmp_path, request.param)
    world.start_master()
    world.start_base()
    yield world
    world.ends.close()


@pytest.fixture
def husky(ros: World, tmp_path: Path) -> Iterator[Husky]:
    """A robot whose bridge is connected to the base."""
    husky = Husky(ros, tmp_path).ready()
    yield husky
    husky.end()
