"""An extension that owns motors, refuses a command and sees the others, as a part of a real robot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.robot.operator import Operator
from tests.support import ROOT, Broker, Child, until

BASE = "pebble/robots/spider"
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


def test_legs_of_an_owner_are_driven_stopped_and_reset(tmp_path: Path) -> None:
    (tmp_path / "legs.py").write_text(LEGS)
    moves, seen, broker = tmp_path / "moves", tmp_path / "seen", Broker(tmp_path)
    path = tmp_path / "robot.json"
    path.write_text(
        json.dumps(
            {
                "robot": {"id": "spider"},
                "transport": {"kind": "zenoh", "run_dir": "run", "state_dir": "state"},
                "local_mqtt": {"port": broker.port},
                "services": {
                    "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": broker.port}}
                },
                "extensions": {"legs.py": {"drives": True}, "absent": {}},
            }
        )
    )
    operator = Operator(broker.port, BASE)

    def send(metric: str, value: dict[str, Any]) -> None:
        operator.send(f"incoming/{metric}", value)

    def moved() -> bool:
        begun = len(moves.read_text())
        send("drive-values", {"x": 0.25, "z": 0.5})
        return until(lambda: "0.25 0.5 True" in moves.read_text()[begun:], 1)

    command = [sys.executable, "-m", "pebble.cli", "up", str(path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = Child(command, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
    try:
        assert until(lambda: operator.newest("status").get("value", {}).get("driveable", {}).get("state") == "yes", 20)
        absent = operator.newest("status")["value"]["services"]["absent"]
        assert (absent["state"], absent["last_exit"]) == ("failed", "not installed")
        offer = operator.newest("capabilities")["value"]
        assert (offer["drive"]["available"], offer["estop"]["owners"]) == (True, ["legs"])
        for sound in ("horn", "bell"):
            send("soundboard-command", {"action": "play", "file": sound})
        assert until(lambda: "bell" in seen.read_text(), 5)
        assert "an extension refuses it soundboard-command \n" in seen.read_text()
        assert '"horn"' not in seen.read_text()
        assert moved()
        assert until(lambda: moves.read_text().endswith("halt\n"), 3)  # no further command has come
        assert moved()
        send("estop", {"by": "ann"})
        assert until(lambda: operator.newest("estop/legs")["latched"], 5)
        assert moves.read_text().endswith("halt\n")
        assert not moved()
        stopped = operator.newest("estop/legs")
        send("estop-reset", {"boot": stopped["boot"], "count": stopped["count"]})
        assert until(lambda: not operator.newest("estop/legs")["latched"], 5)
        assert until(moved, 5)
    finally:
        process.send_signal(signal.SIGTERM)
        code = process.wait(20)
        operator.close()
        broker.stop()
    ended = "halt\na file is closed\na file is closed\n"  # a file may be slow
    assert (code, moves.read_text().endswith(ended)) == (0, True)
