"""A real launcher with real children that misbehave in every possible way, observed from outside."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.extension import Stage
from tests.support import ROOT, WAIT_S, gone, process_name, until

BASE = "pebble/robots/rover"
FAKES = ROOT / "tests" / "fakes"
LOCAL_TRANSPORT, _, DEVICE, CONNECTION = (int(stage) for stage in Stage)

Row = tuple[Any, ...]  # name, behaviour, stage; perhaps a dict of more that a program is


class Robot:
    """A launcher under test, observed from outside: its children's journal, its messages and its stderr."""

    def __init__(self, folder: Path, rows: list[Row], *options: str, env: dict[str, str], **launcher: Any) -> None:
        self.journal, self.record, self.errors = folder / "journal", folder / "record", folder / "errors"
        self.run_dir = folder / "run"
        self.config = folder / "rover.json"
        self.config.write_text(json.dumps(_config(self.run_dir, launcher)))
        table = [
            (name, "fake_service", (name, behaviour, str(self.journal)), stage, *more)
            for name, behaviour, stage, *more in rows
        ]
        self._command = [
            *(sys.executable, str(FAKES / "run_launcher.py"), str(ROOT), str(self.config)),
            *(json.dumps(table), str(self.record), *options),
        ]
        self._folder = folder / "somewhere else"
        self._folder.mkdir()
        (self._folder / "json.py").write_text("raise SystemExit('the working directory was imported from')\n")
        self._environment = {**os.environ, "PYTHONPATH": str(FAKES), **env}
        self.process = self._start(self.errors)

    def _start(self, errors: Path) -> subprocess.Popen[bytes]:
        with errors.open("wb") as out:
            return subprocess.Popen(self._command, cwd=self._folder, env=self._environment, stderr=out)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(WAIT_S)

    def order(self, asker: str, *orders: str) -> None:
        """Have an ``asker`` that is ready request a program: ``media 1``."""
        with Path(f"{self.journal}.orders.{asker}").open("a") as out:
            out.writelines(f"{order}\n" for order in orders)

    def events(self, name: str, event: str) -> list[int]:
        """The pids with which ``name`` noted ``event``."""
        lines = [line.split() for line in lines_of(self.journal)]
        return [int(pid) for who, what, pid in lines if (who, what) == (name, event)]

    def end_leftovers(self) -> list[int]:
        """Kill and return the processes in the journal that still run; there should be none."""
        pids = [int(pid) for pid in re.findall(r"(?:start |child:)(\d+)", "\n".join(lines_of(self.journal)))]
        until(lambda: all(gone(pid) for pid in pids))
        left = [pid for pid in pids if not gone(pid)]
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        return left

    def published(self, metric: str, what: str = "message") -> list[Any]:
        lines = [json.loads(line) for line in lines_of(self.record)]
        return [line for line in lines if line["topic"] == f"{BASE}/outgoing/{metric}" and line["what"] == what]

    def states(self) -> dict[str, str]:
        """The state of each service in the newest status."""
        return {name: one["state"] for name, one in self.services().items()}

    def children(self) -> dict[str, int]:
        """The living children, by the names that the kernel has for them."""
        task = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        named = ((process_name(pid), pid) for pid in map(int, task.read_text().split()))
        return {name: pid for name, pid in named if name}

    def services(self) -> dict[str, Any]:
        statuses = self.published("status")
        return statuses[-1]["payload"]["value"]["services"] if statuses else {}

    def ready(self, *names: str) -> bool:
        return until(lambda: all(self.states().get(name) == "ready" for name in names))

    def logs(self) -> list[Any]:
        return [line["payload"] for line in self.published("logs")]

    def stderr(self) -> str:
        return self.errors.read_text()


def _config(run_dir: Path, launcher: dict[str, Any]) -> dict[str, Any]:
    return {
        "robot": {"id": "rover"},
        "transport": {"kind": "mqtt", "run_dir": str(run_dir)},
        "local_mqtt": {"password": "hush"},
        "services": {
            "defaults": {"retained_publish_interval_seconds": 3600},
            "launcher": launcher,
        },
    }


def lines_of(file: Path) -> list[str]:
    """The complete lines of a file that may still be written to."""
    return file.read_text().rpartition("\n")[0].splitlines() if file.exists() else []


Launch = Callable[..., Robot]


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    robots: list[Robot] = []

    def make(*rows: Row, options: tuple[str, ...] = (), env: dict[str, str] | None = None, **launcher: Any) -> Robot:
        robots.append(Robot(tmp_path, list(rows), *options, env=env or {}, **launcher))
        return robots[-1]

    yield make
    for robot in robots:
        robot.process.kill()  # the children notice by themselves
        robot.process.wait(WAIT_S)
        left = robot.end_leftovers()
        assert not left, f"processes that outlived their launcher: {left}"
