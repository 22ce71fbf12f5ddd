"""A whole robot as real processes, observed only from outside: at the remote broker and at the MCU's pty."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Self

import msgspec

from pebble.extensions.lab.rig.processes import children
from pebble.extensions.lab.simulation.trace import Entry, complete_lines
from tests.kit.stalls import Stall
from tests.robot.operator import Operator
from tests.support import ROOT, WAIT_S, Broker, process_name, until
from tests.tcp_proxy import TcpProxy

BASE = "pebble/robots/rover"
STOP = (0.0, 0.0)
_LISTENS = (b"forwarding between the robot and its remote side", b"to the local one: nothing is mirrored")  # in its log
PROGRAMS = (
    *("zenoh_hub", "announcer", "serial_mcu_bridge", "av_daemon", "mqtt_bridge", "mqtt_mirror"),
    *("camera_publisher", "audio_publisher", "audio_receiver", "video_stream"),
    *("soundboard_handler", "autonomy_manager"),
)
SCRIPTS = Path(__file__).with_name("scripts")
#: A camera and a microphone for ``av_daemon``.
DEVICES = {
    "enabled": True,
    "video": {"backend": "synthetic", "width": 320, "height": 240, "fps": 15},
    "audio": {"source": "synthetic"},
}


class Motors:
    """The serial port of a simulated motor MCU, and the trace of what it received and did."""

    def __init__(self, port: Path, trace: Path) -> None:
        self.port, self._trace = port, trace
        self._entries, self._read = list[Entry](), 0  # what was read, and up to which byte
        self._reading = threading.Lock()

    def forget(self) -> None:
        """Read the trace from here on only: that of an hour takes a second each time."""
        with self._reading:
            self._entries, self._read = [], self._trace.stat().st_size

    def entries(self, since: float = 0.0) -> list[Entry]:
        """What happened on the line after ``since`` (monotonic seconds)."""
        with self._reading:
            lines, self._read = complete_lines(self._trace, self._read)
            self._entries += [msgspec.json.decode(line, type=Entry) for line in lines]
            return [entry for entry in self._entries if entry.ns >= since * 1e9]

    def drives(self, since: float = 0.0) -> list[tuple[float, tuple[float, float]]]:
        """Every drive line after ``since`` as (monotonic seconds, (left, right))."""
        return [(entry.ns / 1e9, entry.drive) for entry in self.entries(since) if entry.drive is not None]

    def moving(self, since: float = 0.0) -> bool:
        drives = self.drives(since)
        return bool(drives) and drives[-1][1] != STOP

    def motors(self, since: float = 0.0) -> list[tuple[float, tuple[float, float]]]:
        """Every change of the motors' outputs after ``since`` as (monotonic seconds, (left, right))."""
        return [(entry.ns / 1e9, entry.motors) for entry in self.entries(since) if entry.motors is not None]

    def late(self, since: float = 0.0) -> list[Stall]:
        """When a busy machine kept the MCU from its port."""
        found = [(entry.ns / 1e9, entry.late_s) for entry in self.entries(since) if entry.late_s]
        return [(at - seconds, at) for at, seconds in found]

    def turning(self) -> bool:
        motors = self.motors()
        return bool(motors) and motors[-1][1] != STOP

    def close(self) -> None:
        """End its process, if it has one of its own."""


class Mcu(Motors):
    """A simulated motor MCU in its own process."""

    def __init__(self, folder: Path, kind: str = "goob") -> None:
        super().__init__(folder / "tty", folder / "trace.jsonl")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "pebble.cli", "sim", kind, "--link", str(self.port),
             "--trace", str(self._trace), "--control"],
            cwd=ROOT, stdin=subprocess.PIPE,
        )  # fmt: skip
        assert until(self.port.exists), "the simulated MCU did not start"

    def command(self, name: str) -> None:
        """``unplug``, ``replug``, ``charge``, …"""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{name}\n".encode())
        self._process.stdin.flush()

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(WAIT_S)


class Rig:
    """Brokers, MCU, robot and operator. ``kind`` is ``mqtt``, ``zenoh`` or ``single`` (one broker for both sides).

    The robot reaches the remote broker through ``uplink``, a proxy that can fail. With ``direct`` it connects without
    the proxy, because a proxy acknowledges TCP segments itself and so changes the timing. ``remote`` replaces its own
    broker, ``operator`` its operator, who subscribes to ``listens`` below the robot's base. ``scripts``: which of ours
    it has. ``top``: more sections of the config; others are services'.
    """

    def __init__(
        self,
        kind: str,
        *,
        name: str = "rover",
        mirror: bool = False,
        mcu: str = "goob",
        start: bool = True,
        direct: bool = False,
        remote: Broker | None = None,
        listens: str = "#",
        operator: Operator | None = None,
        scripts: tuple[str, ...] = (),
        top: dict[str, Any] | None = None,
        **config: Any,
    ) -> None:
        self.kind, self.name, self._extra, self._direct, self._top = kind, name, config, direct, top or {}
        self.charge_later = "charge"  # the MCU command in the middle of a fault
        self._folder = tempfile.TemporaryDirectory(prefix="pbl")
        self.folder = Path(self._folder.name)
        self.remote = remote or Broker(self.folder)
        self.uplink = TcpProxy(self.remote.port)
        self.local = Broker(self.folder) if kind == "mqtt" or mirror else None
        self.mirror, self._scripts = mirror, scripts
        if scripts:
            # the system's may lack paho
            with_paho = {"follow": {"python": sys.executable}} if "follow" in scripts else {}
            manager = {"enabled": True, "autonomy_root": "autonomy", "stop_timeout_seconds": 2.0, "scripts": with_paho}
            self._extra = config | {"autonomy_manager": manager | config.get("autonomy_manager", {})}
        for script in scripts:
            shutil.copytree(SCRIPTS / script, self.folder / "autonomy" / script)
        self.mcu = Mcu(self.folder, mcu)
        self.config = self.folder / "robot.json"
        self.config.write_text(json.dumps(self._config(), indent=1))
        self.log = self.folder / "robot.log"
        self._robot: subprocess.Popen[bytes] | None = None
        self.operator = operator or Operator(self.remote.port, f"pebble/robots/{name}", listens)
        if start:
            try:
                self.start()
            except BaseException:
                self.close()  # the caller cannot: it has no rig yet
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- the robot

    def start(self, ready: bool = True, **options: Any) -> float:
        """Start the launcher; returns the monotonic time just before. Waits until the robot is up if asked.

        ``options`` are those of Popen. What was started and does not come up is stopped.
        """
        began, logged = time.monotonic(), self.log.stat().st_size if self.log.exists() else 0
        with self.log.open("ab") as log:
            options = {"cwd": ROOT, "stdout": log, "stderr": log} | options
            self._robot = subprocess.Popen([sys.executable, "-m", "pebble.cli", "up", str(self.config)], **options)
        if ready:
            try:
                self.wait_until_up(began)
                assert until(lambda: self._listens_since(logged)), (
                    f"nothing is forwarded:\n{self.log.read_text()[-4000:]}"
                )
            except BaseException:
                self.ensure_stopped()
                raise
        return began

    def _listens_since(self, logged: int) -> bool:
        """Whether it is subscribed at its remote broker, some milliseconds after it has said there that it is up."""
        with self.log.open("rb") as log:
            log.seek(logged)
            text = log.read()
        return any(line in text for line in _LISTENS)

    def wait_until_up(self, since: float, timeout: float = 60.0) -> None:
        """Every service is ready, and heartbeats arrive."""
        assert until(lambda: self._up(since), timeout), f"the robot is not up:\n{self.log.read_text()[-4000:]}"

    def stop(self, *signals: signal.Signals) -> int:
        """Stop the robot with SIGTERM, or with these; returns the launcher's exit code."""
        assert self._robot is not None
        for number in signals or (signal.SIGTERM,):
            self._robot.send_signal(number)
        return self._robot.wait(WAIT_S)

    def ensure_stopped(self) -> None:
        """Stop the robot, if it runs."""
        if self._robot is not None and self._robot.poll() is None:
            self.stop()

    def kill_launcher(self) -> list[int]:
        """SIGKILL for the launcher; returns the pids of the children it leaves."""
        assert self._robot is not None
        children = list(self.processes().values())
        self._robot.kill()
        self._robot.wait(WAIT_S)
        return children

    def processes(self) -> dict[str, int]:
        """The launcher's children by program name: ``{"mqtt_bridge": pid, …}``."""
        assert self._robot is not None
        task = Path(f"/proc/{self._robot.pid}/task/{self._robot.pid}/children")
        named = ((_program(pid), pid) for pid in map(int, task.read_text().split()))
        return {name: pid for name, pid in named if name}

    @property
    def launcher_pid(self) -> int:
        assert self._robot is not None
        return self._robot.pid

    def kill(self, program: str) -> float:
        """SIGKILL one process of the robot; returns when."""
        pid = self.processes()[program]
        os.kill(pid, signal.SIGKILL)
        return time.monotonic()

    def shows_driveable(self, state: str, why: str = "", seconds: float = WAIT_S) -> bool:
        """Wait until the status says so; return whether it does."""

        def found() -> bool:
            driveable = self.operator.newest("status").get("value", {}).get("driveable", {})
            return driveable.get("state") == state and why in driveable.get("why", "")

        return until(found, seconds)

    # -- its scripts

    def run_script(self, file: str, config: dict[str, Any] | None = None) -> float:
        """Start a script; returns when the command was sent."""
        began = time.monotonic()
        self.operator.send("incoming/autonomy-command", {"action": "start", "file": file, "config": config or {}})
        return began

    def end_script(self) -> float:
        """Stop the script; returns when the command was sent."""
        began = time.monotonic()
        self.operator.send("incoming/autonomy-command", {"action": "stop"})
        return began

    def script(self) -> dict[str, Any]:
        """Return the newest ``autonomy-status``; empty before the first."""
        return self.operator.newest("autonomy-status")

    def lists_scripts(self, since: float = 0.0) -> bool:
        """True if all of them are in a catalogue that was published after ``since``."""
        seen = [one for one in self.operator.on("outgoing/autonomy-files", since) if since == 0.0 or not one.retain]
        return bool(seen) and set(self._scripts) <= {
            script["file"] for script in seen[-1].json["files"] if script.get("asked", True)
        }

    def close(self) -> None:
        self.operator.close()
        self.ensure_stopped()
        self.mcu.close()
        self.uplink.stop()
        for broker in (self.local, self.remote):
            if broker is not None:
                broker.stop()
        self._folder.cleanup()

    def _up(self, since: float) -> bool:
        status, heartbeat = self.operator.last("outgoing/status"), self.operator.last("outgoing/online")
        if status is None or heartbeat is None or status.at < since or heartbeat.at < since:
            return False
        states = [service["state"] for service in status.json["value"]["services"].values()]
        return bool(states) and set(states) == {"ready"} and heartbeat.json.get("online") is not False

    # -- its config

    def _config(self) -> dict[str, Any]:
        services: dict[str, Any] = {
            "mqtt_bridge": {
                "enabled": True,
                "remote_mqtt": {
                    "host": "127.0.0.1",
                    "port": self.remote.port if self._direct else self.uplink.port,
                },
                **self._actions(),
            },
            "serial_mcu_bridge": {
                "enabled": True,
                "serial": {"port": str(self.mcu.port), "baud": 460800},
                "telemetry": {"publish_touch_sensors": True},
            },
        }
        for name, more in self._extra.items():
            services[name] = {**services.get(name, {}), **more}
        return {"robot": {"id": self.name}, **self._transport(), **self._top, "services": services}

    def _transport(self) -> dict[str, Any]:
        if self.kind == "zenoh":
            own: dict[str, Any] = {
                "kind": "zenoh",
                "run_dir": str(self.folder / "run"),
                "state_dir": str(self.folder / "state"),
            }
            if self.mirror:
                assert self.local is not None
                own["mqtt_mirror"] = {"host": "127.0.0.1", "port": self.local.port}
                return {"local_mqtt": own["mqtt_mirror"], "transport": own}  # where scripts of others look for it
            return {"transport": own}
        # localhost here and 127.0.0.1 there: one broker under two names must be recognised
        port = self.remote.port if self.kind == "single" or self.local is None else self.local.port
        return {
            "local_mqtt": {"host": "localhost", "port": port},
            "transport": {"kind": "mqtt", "run_dir": str(self.folder / "run"), "state_dir": str(self.folder / "state")},
        }

    def recorded(self) -> list[str]:
        """Which action commands ran, in order; recorders stand in for reboot and the like."""
        record = self.folder / "actions.txt"
        return record.read_text().split() if record.exists() else []

    def _actions(self) -> dict[str, Any]:
        def recorder(name: str) -> dict[str, Any]:
            return {"command": ["sh", "-c", f"echo {name} >> {self.folder}/actions.txt"]}

        return {f"{name}_control": recorder(name) for name in ("reboot", "service_restart", "git_pull")}


def lines(rig: Rig, z: float, since: float = 0.0) -> list[float]:
    """When the wheels were told to turn so."""
    return [at for at, wheels in rig.mcu.drives(since) if wheels == (z, z)]


def _program(pid: int) -> str:
    """What a child of the launcher is; "" if it has just ended. The kernel knows the first 15 bytes of its name."""
    comm = process_name(pid)
    return next((name for name in PROGRAMS if name[:15] == comm), comm)


def descendants(pid: int) -> list[int]:
    """The processes that ``pid`` and its descendants have started and that still run."""
    return [found for child in children(pid) for found in (child, *descendants(child))]


def saved_by(broker: Broker) -> dict[Path, bytes]:
    """Let a broker with persistence save; return its files."""
    broker.save()
    return {file: file.read_bytes() for file in broker.store.iterdir()}


def restore(files: dict[Path, bytes]) -> None:
    for file, saved in files.items():
        file.write_bytes(saved)
