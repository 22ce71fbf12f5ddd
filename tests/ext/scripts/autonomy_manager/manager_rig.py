"""The manager as a process of its own on a real transport, with scripts in a folder, seen from outside."""

from __future__ import annotations

import json
import os
import signal
import stat
import sys
from pathlib import Path
from typing import Any

import msgspec

from pebble.transports import Message
from tests.kit.robot import ROBOT, Program, ProgramRobot
from tests.support import ROOT, Child, gone, until

#: Sleeps, and ends as asked; leaves its command line beside itself. It speaks no MQTT and drives nothing.
SLEEPER = """
import json, os, sys, time
with open("started.jsonl", "a") as file:
    file.write(json.dumps([os.getpid(), sys.argv[1:], os.environ.get("PEBBLE_RUN")]) + "\\n")
time.sleep(600)
"""


class ManagerRig(ProgramRobot):
    """``scripts`` of the config are those written with :meth:`script`; drive commands are collected as well."""

    process: Program | Child | None = None

    def __init__(self, kind: str, port: int, **section: Any) -> None:
        super().__init__(kind, port, {}, robot=ROBOT)
        self.root, self.log = self.folder / "scripts", self.folder / "log"
        self.root.mkdir()
        self.drives: list[dict[str, Any]] = []
        self.world.transport.subscribe(f"{self.world.base}/incoming/drive-values", self._on_drive, direct=True)
        times = {"stop_timeout_seconds": 2}
        self.section: dict[str, Any] = {"enabled": True, "autonomy_root": str(self.root), **times, **section}
        self.section["scripts"] = {}
        self.raw["services"] = {"autonomy_manager": self.section}
        self._ends.callback(self.end)

    def script(self, name: str, text: str = SLEEPER, file: str = "run.py", **section: Any) -> Path:
        """Write a script."""
        folder = self.root / name
        folder.mkdir()
        (folder / file).write_text(text)
        (folder / file).chmod(stat.S_IRWXU)
        self.section["scripts"][name] = section
        return folder

    def start(self, *command: str) -> None:
        """Start the manager alone, or with ``command`` what runs it."""
        before = len(self.world.on("autonomy-files"))
        self.config = self.write()
        if command:
            with self.log.open("a") as log:
                self.process = Child([sys.executable, "-m", *command, str(self.path)], cwd=ROOT, stderr=log)
        else:
            self.process = Program("pebble.services.autonomy_manager.service:AutonomyManager", str(self.path))
        assert until(lambda: len(self.world.on("autonomy-files")) > before and self.listed(), 20), self.logged()

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.send_signal(number)
            process.wait(10)

    def listed(self) -> bool:
        """True if every script is in the published list, and was asked what it needs."""
        asked = {entry["file"] for entry in self.newest("autonomy-files").get("files", ()) if entry.get("asked", True)}
        return bool(self.newest("autonomy-files")) and asked >= set(self.section["scripts"])

    def newest(self, metric: str) -> Any:
        return self.world.newest(metric)

    @property
    def status(self) -> dict[str, Any]:
        status: dict[str, Any] = self.newest("autonomy-status")
        return status

    def becomes(self, timeout: float = 10.0, **fields: Any) -> bool:
        """Wait until the status has these fields."""
        return self.world.became("autonomy-status", timeout, **fields)

    def command(self, body: Any, *, retain: bool = False) -> None:
        self.world.command("autonomy-command", body, retain=retain)

    def launch(self, name: str, **config: Any) -> None:
        """Send the command that starts a script."""
        self.command({"action": "start", "file": name, "config": config})

    def run_script(self, name: str, **config: Any) -> int:
        """Start a script, and return its pid once it is published as running."""
        self.launch(name, **config)
        assert self.becomes(running=True, file=name), (self.status, self.logged())
        return int(self.status["pid"])

    def logged(self) -> str:
        return self.process.printed if isinstance(self.process, Program) else self.log.read_text()

    def _on_drive(self, message: Message) -> None:
        self.drives.append(msgspec.json.decode(message.payload))


def started(folder: Path) -> list[tuple[int, list[str], str | None]]:
    """What each start of a sleeper left in its folder: pid, arguments, and its run."""
    try:
        lines = (folder / "started.jsonl").read_text().splitlines()
    except FileNotFoundError:
        return []
    return [tuple(json.loads(line)) for line in lines]


def alive(*markers: str) -> list[int]:
    """The processes that are alive at one time and whose command line contains one of ``markers``."""
    found = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit() and _marked(entry, markers)]
    return [pid for pid in found if not gone(pid)]  # one that was found first may have ended before the last was found


def _marked(process: Path, markers: tuple[str, ...]) -> bool:
    try:
        words = (process / "cmdline").read_bytes()
    except OSError:
        return False
    return int(process.name) != os.getpid() and any(marker.encode() in words for marker in markers)
