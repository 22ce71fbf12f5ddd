"""A simulated robot as processes: an MCU on a pty, a local broker if it needs one, the launcher with its services.

Nothing large is imported here: the memory of these processes is measured, and shared libraries divide theirs among all
processes that map them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pebble.config import load
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.launcher.programs import programs
from pebble.rig.broker import Broker
from pebble.rig.processes import MCUS, ROBOTS, Processes, python
from pebble.rig.programs import Program, Wrap, children, unchanged
from pebble.simulation.trace import Entry, read_trace

KINDS = ("mqtt", "zenoh")
LAUNCHER, BROKER = "launcher", "mosquitto"
NAME = "rover"
BASE = Identity("pebble", "robots", NAME).base
_HOST = "127.0.0.1"
_MCU_START_S = 15.0
_COMM_BYTES = 15  # of a process's name in the kernel

Config = Mapping[str, Any]


class Robot:
    """``kind`` is its local transport. It connects to a broker for operators at ``remote``, host and port.

    ``services``: fields of its services' configs besides these connections; one that is named is enabled. ``reports``:
    whether every report of its MCU is recorded and forwarded, 50 a second; None: as is usual. ``wrap`` extends the
    commands of all processes that use the network. Its processes are among ``running``, and end with them.
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
        reports: bool | None = False,
        wrap: Wrap = unchanged,
    ) -> None:
        self.kind, self.name, self.remote, self.base = kind, name, remote, Identity("pebble", "robots", name).base
        self.folder = folder or running.folder
        self.run_dir, self.config = self.folder / "run", self.folder / "robot.json"
        self.port, self._trace = self.folder / "mcu", self.folder / "trace.jsonl"
        self.local_broker: Broker | None = None
        self.running, self._services, self.reports, self._wrap = running, services or {}, reports, wrap
        self._mcu: Program | None = None
        self._started: list[Program] = []

    def prepare(self) -> None:
        """Starts what the robot needs and writes its config. Raises PebbleError if a process does not start."""
        self.folder.mkdir(exist_ok=True)
        if self.kind != "zenoh":
            self.local_broker = self.running.broker("local", folder=self.folder, wrap=self._wrap)
            if self._wrap is unchanged:  # else it is in another network
                self.local_broker.wait()
        self._trace.touch()
        options = ["--link", self.port, "--trace", self._trace, *(["--trace-said"] if self.reports else [])]
        command = python("pebble.simulation.mcu", "--kind", "goob", *options)
        self._mcu = self.running.add(Program("MCU", command, self.folder / "mcu.log"), MCUS)
        self._mcu.wait_until(self.port.exists, _MCU_START_S)
        self.config.write_text(json.dumps(self._contents(), indent=1))

    def launch(self) -> None:
        self.start(f"the {self.kind} robot", python("pebble.cli", "up", self.config))

    def lines(self, since_ns: int) -> list[Entry]:
        """What the MCU received, did and (with ``reports``) sent after ``since_ns`` (CLOCK_MONOTONIC)."""
        return [entry for entry in read_trace(self._trace) if entry.ns >= since_ns]

    def log(self) -> str:
        """The end of the robot's log."""
        return "" if self.launcher is None else self.launcher.tail()

    @property
    def launcher(self) -> Program | None:
        return self._started[0] if self._started else None

    # -- its processes

    @property
    def programs(self) -> list[Program]:
        """All that were started for it."""
        return [*(one for one in (self.local_broker, self._mcu) if one is not None), *self._started]

    @property
    def remote_port(self) -> int:
        return self.remote[1]

    @property
    def broker_ports(self) -> list[int]:
        """The remote broker's port, then that of the local broker, if there is one."""
        return [self.remote_port, *([] if self.local_broker is None else [self.local_broker.port])]

    def pids(self) -> list[int]:
        """The launcher, its children (including a hub), and the local broker, if there is one."""
        local = [] if self.local_broker is None else [self.local_broker.pid]
        own = [pid for program in self._started for pid in (program.pid, *children(program.pid))]
        return [*own, *local] if own else []

    def processes(self) -> dict[str, int]:
        """The same by name."""
        if self.launcher is None:
            return {}
        names = {name[:_COMM_BYTES]: name for name in self._programs_of()}
        found = {LAUNCHER: self.launcher.pid}
        for pid in children(self.launcher.pid):
            comm = _comm(pid)
            if comm:
                found[names.get(comm, comm)] = pid
        if self.local_broker is not None:
            found[BROKER] = self.local_broker.pid
        return found

    def complete(self) -> bool:
        """Whether all its programs run, including those started on demand."""
        return self._programs_of() <= self.processes().keys()

    def expect(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        """Waits for the condition. Raises PebbleError with the robot's log after ``timeout`` seconds, or if it ends."""
        if self.launcher is None:
            raise PebbleError("the robot was not launched")
        try:
            self.launcher.wait_until(condition, timeout)
        except PebbleError as error:
            raise PebbleError(f"{what}: {error}\n{self.log()}") from None

    def _programs_of(self) -> set[str]:
        return {program.name for program in programs(load(self.config))}

    def start(self, name: str, command: Sequence[str]) -> None:
        """One of the robot's own processes."""
        program = Program(name, self._wrap(command), self.folder / "robot.log")
        self._started.append(self.running.add(program, ROBOTS))

    def _contents(self) -> dict[str, Any]:
        """Of its config file."""
        host, port = self.remote
        services: dict[str, Any] = {
            "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": host, "port": port}},
            "serial_mcu_bridge": {"enabled": True, "serial": {"port": str(self.port), "baud": 460_800}},
        }
        if self.reports is not None:
            services["serial_mcu_bridge"]["telemetry"] = {"publish_touch_sensors": self.reports}
        for service, fields in self._services.items():
            services[service] = {**services.get(service, {"enabled": True}), **fields}
        folders = {"run_dir": str(self.run_dir), "state_dir": str(self.run_dir)}
        config: dict[str, Any] = {"robot": {"id": self.name}, "transport": {"kind": self.kind, **folders}}
        if self.local_broker is not None:
            config["local_mqtt"] = {"host": "localhost", "port": self.local_broker.port}
        return {**config, "services": services}


def synthetic_media(camera: tuple[int, int, int], published: tuple[int, int, int]) -> dict[str, Config]:
    """Services of a robot with a camera and a microphone; width, height and rate of what is captured and published."""
    names = ("width", "height", "fps")
    sizes = {f"publish_{name}": value for name, value in zip(names, published, strict=True)}
    return {
        "mqtt_bridge": {"media": {"video_publisher": sizes}},
        "av_daemon": {
            "video": {"backend": "synthetic", **dict(zip(names, camera, strict=True))},
            "audio": {"source": "synthetic"},
        },
    }


#: What most comparisons use.
MEDIA = synthetic_media((640, 480, 15), (640, 480, 15))


@contextmanager
def one_robot(kind: str, make: Callable[..., Robot] = Robot, **options: Any) -> Iterator[Robot]:
    """A robot of its own with a remote broker of its own, ready to be launched. Raises PebbleError."""
    with Processes() as processes:
        broker = processes.broker("remote")
        robot = make(processes, kind, (_HOST, broker.port), **options)
        broker.wait()
        robot.prepare()
        yield robot


def check_kinds(kinds: Sequence[str], *, also: Sequence[str] = ()) -> None:
    """Raises PebbleError naming an unknown or repeated transport. ``also`` may be named besides ours."""
    known = (*KINDS, *also)
    unknown = [kind for kind in kinds if kind not in known]
    if unknown or not kinds:
        raise PebbleError(f"unknown transport {', '.join(unknown)}: there are {', '.join(known)}")
    if len(set(kinds)) < len(kinds):
        raise PebbleError(f"{', '.join(kinds)}: name each transport once")


def _comm(pid: int) -> str:
    """A process's name in the kernel; empty if it has just ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""
