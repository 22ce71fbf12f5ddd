"""A simulated robot as processes: an MCU on a pty, a local broker if it needs one, the launcher with its services.

Nothing large is imported here. Comparisons measure these processes' memory as PSS, in which each process that maps a
library has a part of it: a library that this process loaded, too, would make the robot's look smaller.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from pebble.config import load
from pebble.config.raw import deep_merge
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.extensions.lab.rig.processes import (
    HOST,
    MCUS,
    ROBOTS,
    Broker,
    Processes,
    Program,
    Wrap,
    children,
    python,
    unchanged,
)
from pebble.extensions.lab.simulation.trace import Entry, complete_lines, read_trace
from pebble.launcher.programs import programs

KINDS = ("mqtt", "zenoh")
NAME = "rover"
BASE = Identity("pebble", "robots", NAME).base
START_S = 15.0  # of an MCU or the page's server, on a small machine

Config = Mapping[str, Any]


class SimulatedRobot:
    """A robot on this machine. Its processes are among ``running``, and end with them.

    ``entries()`` are what its MCU received and did, noted there, independently of telemetry.
    """

    runs_on: str
    has_media = has_scripts = False

    def __init__(self, running: Processes, name: str, folder: Path) -> None:
        self.running, self.name, self.folder = running, name, folder
        self.base = Identity("pebble", "robots", name).base
        self.folder.mkdir(exist_ok=True)
        self.programs: list[Program] = []  # all that were started for it
        self._trace, self._trace_read = folder / "trace.jsonl", 0
        self._entries: deque[Entry] = deque(maxlen=5_000)  # minutes of commands

    def entries(self) -> list[Entry]:
        """Return the lines that the MCU received and the changes of its motors, oldest first."""
        lines, self._trace_read = complete_lines(self._trace, self._trace_read)
        self._entries.extend(msgspec.json.decode(line, type=Entry) for line in lines)
        return list(self._entries)

    def _add(self, name: str, command: Sequence[str], kind: int, log: str) -> Program:
        self.programs.append(self.running.add(Program(name, command, self.folder / log), kind))
        return self.programs[-1]

    def _start_mcu(self, kind: str, *options: object, name: str = "MCU") -> Program:
        command = python("pebble.cli", "sim", kind, *options)
        return self._add(f"{self.name}'s {name}", command, MCUS, f"{name}.log")

    def _start_board(self, kind: str, port: Path, trace: Path, *options: object, name: str = "MCU") -> Program:
        """Start an MCU on a pty, and return its program."""
        return self._start_mcu(kind, "--link", port, "--trace", trace, *options, name=name)


class Robot(SimulatedRobot):
    """A simulated robot with the launcher and its services; ``kind`` is its local transport.

    It connects to a broker for operators at ``remote``, host and port. ``services``: more fields of its services'
    configs; a service that is named there is enabled. ``reports``: every report of its MCU is recorded and forwarded,
    50 a second. ``wrap`` extends the commands of all processes that use the network.
    """

    def __init__(
        self,
        running: Processes,
        kind: str,
        remote: tuple[str, int],
        *,
        name: str = NAME,
        folder: Path | None = None,
        services: Mapping[str, Config] | None = None,
        reports: bool = False,
        wrap: Wrap = unchanged,
    ) -> None:
        super().__init__(running, name, folder or running.folder)
        self.kind = kind
        self._remote_host, self.remote_port = remote
        self.run_dir, self.config, self.port = (self.folder / file for file in ("run", f"{name}.json", "mcu"))
        self.local_broker: Broker | None = None
        self.local_port: int | None = None  # of the local broker, which may be that of several robots
        self.reports, self._wrap = reports, wrap
        self._started: list[Program] = []  # by ``start``: the launcher, or the programs in its place
        motors = {"serial": {"baud": 460_800}, "telemetry": {"publish_touch_sensors": reports}}
        self._services: dict[str, Config] = {"mqtt_bridge": {}, "serial_mcu_bridge": motors, **(services or {})}
        self._base_config: Config = {"robot": {"id": name}, "transport": {"kind": kind}}  # without services

    def prepare(self, ending: threading.Event | None = None) -> None:
        """Start the processes that the robot needs, and write its config; stop waiting once ``ending`` is set.

        Raises PebbleError if a process does not start.
        """
        if self.kind != "zenoh" and self.local_port is None:
            self.local_broker = self.running.broker("local", folder=self.folder, wrap=self._wrap)
            self.programs.append(self.local_broker)
            self.local_port = self.local_broker.port
            if self._wrap is unchanged:  # else it is in another network
                self.local_broker.wait()
        self._trace.touch()
        self._start_motors().wait_until(self.port.exists, START_S, ending)
        connections: dict[str, Any] = {
            "transport": {"run_dir": str(self.run_dir), "state_dir": str(self.folder / "state")},
            "local_mqtt": None if self.local_port is None else {"host": "localhost", "port": self.local_port},
            "services": {
                "mqtt_bridge": {"remote_mqtt": {"host": self._remote_host, "port": self.remote_port}},
                "serial_mcu_bridge": {"serial": {"port": str(self.port)}},
            },
        }
        services = {name: {"enabled": True, **fields} for name, fields in self._services.items()}
        contents = deep_merge(deep_merge(self._base_config, {"services": services}), connections)
        self.config.write_text(json.dumps(contents, indent=1))

    def launch(self) -> None:
        self.start(f"the {self.kind} robot", python("pebble.cli", "up", self.config))

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start one of the robot's own processes."""
        self._started.append(self._add(name, self._wrap(command), ROBOTS, "robot.log"))

    def _start_motors(self) -> Program:
        return self._start_board("goob", self.port, self._trace, *(["--trace-said"] if self.reports else []))

    def lines(self, since_ns: int) -> list[Entry]:
        """Return what the MCU received, did and (with ``reports``) sent after ``since_ns`` (CLOCK_MONOTONIC)."""
        return [entry for entry in read_trace(self._trace) if entry.ns >= since_ns]

    # -- its processes, once it is launched

    @property
    def launcher(self) -> Program:
        return self._started[0]

    def log(self) -> str:
        """Return the end of the robot's log."""
        return self.launcher.tail()

    def processes(self) -> dict[str, int]:
        """Return the process ids of the launcher, its children (a hub among them) and the local broker, by name."""
        names = {name[:15]: name for name in self._programs()}  # the kernel keeps 15 characters of a name
        pids = {"launcher": self.launcher.pid}
        for pid in children(self.launcher.pid):
            with suppress(OSError):  # it has just ended
                kernel_name = Path(f"/proc/{pid}/comm").read_text().strip()
                pids[names.get(kernel_name, kernel_name)] = pid
        return pids if self.local_broker is None else pids | {"mosquitto": self.local_broker.pid}

    def complete(self) -> bool:
        """True if all programs of the robot run, including on-demand ones."""
        return self._programs() <= self.processes().keys()

    def _programs(self) -> set[str]:
        return {program.name for program in programs(load(self.config))}

    def expect(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        """Wait for the condition. Raises PebbleError with the robot's log after ``timeout`` seconds, or if it ends."""
        try:
            self.launcher.wait_until(condition, timeout)
        except PebbleError as error:
            raise PebbleError(f"{what}: {error}\n{self.log()}") from None


#: Services of a robot with a camera and a microphone.
MEDIA: dict[str, Config] = {
    "mqtt_bridge": {"media": {"video_publisher": {"publish_width": 640, "publish_height": 480, "publish_fps": 15}}},
    "av_daemon": {
        "video": {"backend": "synthetic", "width": 640, "height": 480, "fps": 15},
        "audio": {"source": "synthetic"},
    },
}


@contextmanager
def one_robot(kind: str, make: type[Robot] = Robot, **options: Any) -> Iterator[Robot]:
    """Yield a robot with a remote broker of its own, ready to be launched. Raises PebbleError."""
    with Processes() as processes:
        broker = processes.broker("remote")
        robot = make(processes, kind, (HOST, broker.port), **options)
        broker.wait()
        robot.prepare()
        yield robot
