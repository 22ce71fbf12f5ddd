"""The core alone: without extensions and without their packages it runs a robot, on both transports."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.extension import OURS
from tests.robot.operator import Operator
from tests.support import ROOT, Broker, Child, until

BASE = "pebble/robots/rover"
DEPENDENCIES = importlib.metadata.requires("pebble-robot") or []
CORE = [re.split(r"[ <>=~;\[]", line)[0] for line in DEPENDENCIES if "extra ==" not in line]


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the core and the packages that it needs, and those that they need."""
    folder = tmp_path_factory.mktemp("core")
    shutil.copytree(ROOT / "pebble", folder / "pebble", ignore=shutil.ignore_patterns("__pycache__"))
    for name in OURS:
        shutil.rmtree(folder / name.replace(".", "/"))
    assert [*(folder / "pebble" / "extensions").glob("*/")] == []
    for name in packages(CORE):
        files = importlib.metadata.distribution(name).files or ()
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            place = Path(str(importlib.metadata.distribution(name).locate_file(top)))
            if not (folder / top).exists():
                (folder / top).symlink_to(place)
    return folder


def packages(names: list[str]) -> set[str]:
    found: set[str] = set()
    waiting = [*names]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            needed = importlib.metadata.requires(name) or []
            waiting += [re.split(r"[ <>=~;\[(!]", line)[0] for line in needed if ";" not in line]
    return found


class Line:
    """The other end of a serial line, as a board without a program: it reads, and counts no wheels."""

    def __init__(self) -> None:
        self._board, pebble_end = os.openpty()
        tty.setraw(pebble_end)
        os.set_blocking(self._board, False)
        self.port, self._pebble_end = os.ttyname(pebble_end), pebble_end
        self.lines: list[str] = []
        self._rest = ""

    def read(self) -> list[str]:
        try:
            text = self._rest + os.read(self._board, 65536).decode()
        except (BlockingIOError, OSError):
            return self.lines
        *lines, self._rest = text.split("\n")
        self.lines += [line for line in lines if line.startswith("M ")]
        return self.lines

    def send(self, data: bytes) -> None:
        os.write(self._board, data)

    def end(self) -> None:
        os.close(self._board)
        os.close(self._pebble_end)


@contextmanager
def robot(core: Path, kind: str, line: Line, broker: Broker, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    config = {
        "robot": {"id": "rover"},
        "transport": {"kind": kind},
        "local_mqtt": {"port": broker.port},
        "services": {
            "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": broker.port}},
            "serial_mcu_bridge": {"enabled": True, "serial": {"port": line.port}},
        },
    }
    path = folder / "robot.json"
    path.write_text(json.dumps(config))
    environment = {"PYTHONPATH": str(core), "PATH": os.environ["PATH"], "XDG_RUNTIME_DIR": str(folder)}
    environment |= {"XDG_STATE_HOME": str(folder)}
    with (folder / "log").open("wb") as log:
        command = [sys.executable, "-S", "-m", "pebble.cli", "up", str(path)]  # -S: without the packages of this venv
        process = Child(command, cwd=folder, env=environment, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0, (folder / "log").read_text()


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_a_robot_is_started_driven_and_stopped_and_its_line_ends(core: Path, kind: str, tmp_path: Path) -> None:
    broker, line = Broker(tmp_path), Line()
    operator = Operator(broker.port, BASE)

    def driveable() -> dict[str, str]:
        value: dict[str, Any] = operator.newest("status").get("value", {})
        found: dict[str, str] = value.get("driveable", {})
        return found

    def shows(data: bytes, state: str, why: str = "") -> bool:
        line.send(data)
        return driveable().get("state") == state and why in driveable().get("why", "")

    def driven(wanted: str) -> bool:
        operator.send("incoming/drive-values", {"x": 0, "z": 0.5})
        time.sleep(0.05)
        return line.read()[-1:] == [wanted]

    try:
        with robot(core, kind, line, broker, tmp_path):
            assert until(lambda: driveable().get("state") == "unknown", 20)
            noise = b"\xff\x00\x80\n>>> \nM 0.000 0.000\nT a0=\n"
            assert until(lambda: shows(noise, "unknown", "what its board sends is not understood"), 10, step=0.1)
            assert until(lambda: shows(b"OK M\n", "yes"), 10, step=0.1)
            assert until(lambda: driven("M 0.500 0.500"), 10)
            begun = time.monotonic()
            assert until(lambda: line.read()[-1] == "M 0.000 0.000", 5)
            assert time.monotonic() - begun < 2
            assert until(lambda: driven("M 0.500 0.500"), 10)
            operator.send("incoming/estop", {"by": "ann"})
            assert until(lambda: operator.newest("estop/serial").get("latched") is True, 5)
            assert line.read()[-1] == "M 0.000 0.000"
            count = len(line.lines)
            assert not any(driven("M 0.500 0.500") for _ in range(10))
            assert {*line.read()[count:]} <= {"M 0.000 0.000"}
            line.end()
            assert until(lambda: driveable().get("state") == "no", 10)
    finally:
        operator.close()
        broker.stop()
