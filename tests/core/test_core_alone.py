"""The core alone runs a robot: without our extensions and their packages, on both transports, with owners of motors."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shutil
import signal
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
from tests.support import ROOT, SOON_S, WAIT_S, Broker, Child, until

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
def robot(core: Path, kind: str, broker: Broker, folder: Path, **more: Any) -> Iterator[Operator]:
    """Run a robot with ``more`` in its config, and yield an operator of it."""
    bridge = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": broker.port}}
    config = {
        "robot": {"id": "rover"},
        "transport": {"kind": kind},
        "local_mqtt": {"port": broker.port},
        **more,
        "services": {"mqtt_bridge": bridge, **more.get("services", {})},
    }
    path = folder / "robot.json"
    path.write_text(json.dumps(config))
    environment = {"PYTHONPATH": str(core), "PATH": os.environ["PATH"], "XDG_RUNTIME_DIR": str(folder)}
    environment |= {"XDG_STATE_HOME": str(folder)}
    operator = Operator(broker.port, BASE)
    with (folder / "log").open("wb") as log:
        command = [sys.executable, "-S", "-m", "pebble.cli", "up", str(path)]  # -S: without the packages of this venv
        process = Child(command, cwd=folder, env=environment, stdout=log, stderr=log)
        try:
            yield operator
        finally:
            process.send_signal(signal.SIGTERM)
            code = process.wait(WAIT_S)
            operator.close()
            assert code == 0, (folder / "log").read_text()


def driveable(operator: Operator) -> dict[str, str]:
    value: dict[str, Any] = operator.newest("status").get("value", {})
    found: dict[str, str] = value.get("driveable", {})
    return found


def test_a_robot_with_a_board_is_driven_and_stopped_and_its_line_ends(
    core: Path, broker: Broker, tmp_path: Path
) -> None:
    line = Line()
    board = {"enabled": True, "serial": {"port": line.port}}
    with robot(core, "mqtt", broker, tmp_path, services={"serial_mcu_bridge": board}) as operator:

        def shows(data: bytes, state: str, why: str = "") -> bool:
            line.send(data)
            return driveable(operator).get("state") == state and why in driveable(operator).get("why", "")

        def driven(wanted: str) -> bool:
            operator.send("incoming/drive-values", {"x": 0, "z": 0.5})
            time.sleep(0.05)
            return line.read()[-1:] == [wanted]

        assert until(lambda: driveable(operator).get("state") == "unknown")
        noise = b"\xff\x00\x80\n>>> \nM 0.000 0.000\nT a0=\n"
        assert until(lambda: shows(noise, "unknown", "what its board sends is not understood"), step=0.1)
        assert until(lambda: shows(b"OK M\n", "yes"), step=0.1)
        assert until(lambda: driven("M 0.500 0.500"))
        assert until(lambda: line.read()[-1] == "M 0.000 0.000", SOON_S)
        assert until(lambda: driven("M 0.500 0.500"))
        operator.send("incoming/estop", {"by": "ann"})
        assert until(lambda: operator.newest("estop/serial").get("latched") is True)
        assert line.read()[-1] == "M 0.000 0.000"
        count = len(line.lines)
        assert not any(driven("M 0.500 0.500") for _ in range(10))
        assert {*line.read()[count:]} <= {"M 0.000 0.000"}
        line.end()
        assert until(lambda: driveable(operator).get("state") == "no")


#: An extension of an owner: it has motors, refuses a command and sees the others.
LEGS = """
import sys
from pathlib import Path

from pebble.extension import Extension, Program, Stage
from pebble.forwarding.observer import Observer
from pebble.motors.motor_owner import MotorOwner
from pebble.motors.state_file import StateFile
from pebble.runtime.process import run

MOVES, SEEN = Path(__file__).with_name("moves"), Path(__file__).with_name("seen")


class Seen(Observer):
    def __init__(self, _config, _clock):
        SEEN.touch()

    def passed(self, channel, by, payload):
        self.write("passed", channel, payload)
        raise ValueError("what it raises ends nothing")

    def refused(self, drop, channel, by):
        self.write(drop.value, channel, b"")

    def write(self, what, channel, payload):
        with SEEN.open("a") as file:
            file.write(f"{what} {channel.metric} {payload.decode()}\\n")


def step(_config):
    return lambda _side, _subject, message: "it is night" if b"horn" in message.payload else ""


class Legs(MotorOwner):
    name = owner = "legs"

    def start(self) -> None:
        self.halt()
        self.on_stop(self.halt)
        super().start()
        self.report(True)

    def move(self, drive, valid_s):
        self.write(f"{drive.x:g} {drive.z:g} {0 < valid_s <= 0.75}")

    def halt(self):
        self.write("halt")

    def write(self, line):
        with MOVES.open("a") as file:
            file.write(line + "\\n")


StateFile.close = lambda _file: Legs.write(None, "a file is closed")
EXTENSION = Extension(
    name="legs",
    package="legs.py",
    program=Program("legs", "legs", stage=Stage.DEVICE, preloaded=False),
    motors={"legs": "legs"},
    observer="legs:Seen",
    step="legs:step",
)

if __name__ == "__main__":
    sys.exit(run(Legs))
"""


def test_legs_of_an_owner_are_driven_stopped_and_reset(core: Path, broker: Broker, tmp_path: Path) -> None:
    (tmp_path / "legs.py").write_text(LEGS)
    moves, seen = tmp_path / "moves", tmp_path / "seen"
    extensions: dict[str, Any] = {"legs.py": {"drives": True}, "absent": {}}
    with robot(core, "zenoh", broker, tmp_path, extensions=extensions) as operator:

        def moved() -> bool:
            begun = len(moves.read_text())
            operator.send("incoming/drive-values", {"x": 0.25, "z": 0.5})
            return until(lambda: "0.25 0.5 True" in moves.read_text()[begun:], 1)

        assert until(lambda: driveable(operator).get("state") == "yes")
        absent = operator.newest("status")["value"]["services"]["absent"]
        assert (absent["state"], absent["last_exit"]) == ("failed", "not installed")
        offer = operator.newest("capabilities")["value"]
        assert (offer["drive"]["available"], offer["estop"]["owners"]) == (True, ["legs"])
        for sound in ("horn", "bell"):
            operator.send("incoming/soundboard-command", {"action": "play", "file": sound})
        assert until(lambda: "bell" in seen.read_text())
        assert "an extension refuses it soundboard-command \n" in seen.read_text()
        assert '"horn"' not in seen.read_text()
        assert moved()
        assert until(lambda: moves.read_text().endswith("halt\n"))  # no further command has come
        assert moved()
        operator.send("incoming/estop", {"by": "ann"})
        assert until(lambda: operator.newest("estop/legs")["latched"])
        assert moves.read_text().endswith("halt\n")
        assert not moved()
        stopped = operator.newest("estop/legs")
        operator.send("incoming/estop-reset", {"boot": stopped["boot"], "count": stopped["count"]})
        assert until(lambda: not operator.newest("estop/legs")["latched"])
        assert until(moved)
    ended = "halt\na file is closed\na file is closed\n"  # a file may be slow
    assert moves.read_text().endswith(ended)
