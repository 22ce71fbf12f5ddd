"""The manager as a process of its own on a real transport, with scripts in a folder, seen from outside."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from pebble.transports import Message
from tests.kit.robot import BASE, ROBOT, Listener, LocalNetwork
from tests.support import ROOT, Child, gone, until

#: Sleeps, and ends as asked; leaves its command line beside itself. It speaks no MQTT and drives nothing.
SLEEPER = """
import json, os, sys, time
with open("started.jsonl", "a") as file:
    file.write(json.dumps([os.getpid(), sys.argv[1:], os.environ.get("PEBBLE_RUN")]) + "\\n")
time.sleep(600)
"""


class ManagerRig:
    """``scripts`` of the config are those written with :meth:`script`; drive commands are collected as well."""

    def __init__(self, kind: str, folder: Path, **section: Any) -> None:
        self._ends = ExitStack()
        self.folder, self.root = folder, folder / "scripts"
        self.root.mkdir()
        self.network = LocalNetwork(kind, folder)
        self._ends.callback(self.network.close)
        self.world = Listener(self.network.client("world"))
        self._ends.callback(self.world.transport.close)
        self.drives: list[dict[str, Any]] = []
        self.world.transport.subscribe(f"{BASE}/incoming/drive-values", self._on_drive, direct=True)
        self.section: dict[str, Any] = {"scan_interval_seconds": 1, "stop_timeout_seconds": 2, **section}
        self.section["scripts"] = {}
        self.process: subprocess.Popen[str] | None = None
        self._ends.callback(self.end)

    def script(self, name: str, text: str = SLEEPER, file: str = "run.py", **section: Any) -> Path:
        """Write a script; its own drive commands count as a person's, because nothing here needs a gate."""
        folder = self.root / name
        folder.mkdir()
        (folder / file).write_text(text)
        (folder / file).chmod(stat.S_IRWXU)
        self.section["scripts"][name] = {"arbitrate": False, **section}
        return folder

    def start(self, *command: str) -> None:
        """Start the manager alone, or with ``command`` what runs it."""
        config, before = self.folder / f"{ROBOT}.json", len(self.world.on("autonomy-files"))
        raw = {
            "robot": {"id": ROBOT},
            "transport": {
                "kind": "mqtt",
                "run_dir": str(self.folder / "run"),
                **self.network.transport,
                "state_dir": str(self.folder / "state"),
            },
            "local_mqtt": self.network.local_mqtt,
            "services": {"autonomy_manager": {"enabled": True, "autonomy_root": str(self.root), **self.section}},
        }
        config.write_text(json.dumps(raw))
        self.log = self.folder / "log"
        with self.log.open("a") as log:
            words = command or ("pebble.services.autonomy_manager",)
            self.process = Child([sys.executable, "-m", *words, str(config)], cwd=ROOT, stderr=log)
        assert until(lambda: len(self.world.on("autonomy-files")) > before and self.listed(), 20), self.logged()

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.send_signal(number)
            process.wait(10)

    def listed(self) -> bool:
        """Whether every script is in the published list."""
        files = self.newest("autonomy-files")
        return files is not None and {entry["file"] for entry in files["files"]} >= set(self.section["scripts"])

    def newest(self, metric: str) -> Any:
        payloads = self.world.retained(metric)
        return msgspec.json.decode(payloads[0]) if payloads else None

    @property
    def status(self) -> dict[str, Any]:
        return self.newest("autonomy-status") or {}

    def command(self, body: Any, *, retain: bool = False) -> None:
        self.world.command("autonomy-command", body, retain=retain)

    def run(self, name: str, **config: Any) -> int:
        """Start a script, and return its pid once it is published as running."""
        self.command({"action": "start", "file": name, "config": config})
        assert until(lambda: self.status.get("running") and self.status["file"] == name), (self.status, self.logged())
        return int(self.status["pid"])

    def logged(self) -> str:
        return self.log.read_text()

    def close(self) -> None:
        self._ends.close()

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
