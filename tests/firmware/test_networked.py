"""The program that is a MiniLAMP or a BenJr: real processes, a real broker."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.commands import app
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation.trace import read_trace
from tests.robot.operator import Operator
from tests.support import ROOT, Broker, Child, until

END_S = 1.0
NAME = 'The "lamp", naïve'  # as JSON must escape it


class Program:
    """One robot as a process; what it writes goes into files."""

    def __init__(self, folder: Path, kind: str, broker: str, *options: str) -> None:
        self._files = folder / f"{kind}.out", folder / f"{kind}.err"
        out, err = (path.open("wb") for path in self._files)
        command = [sys.executable, "-m", "pebble.cli", "sim", kind, "--broker", broker, *options]
        with out, err:
            self.process = Child(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=err)

    @property
    def out(self) -> bytes:
        return self._files[0].read_bytes()

    @property
    def err(self) -> str:
        return self._files[1].read_text()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Any]:
    programs: list[Program] = []

    def start(*arguments: str) -> Program:
        programs.append(Program(tmp_path, *arguments))
        return programs[-1]

    yield start
    for program in programs:
        program.process.kill()
        program.process.wait()


def test_one_is_driven_and_ends_at_once_by_a_signal_with_motors_off(start: Any, broker: Broker, tmp_path: Path) -> None:
    address, trace = f"127.0.0.1:{broker.port}", tmp_path / "trace.jsonl"
    program = start("minilamp", f"mqtt://{address}", "--name", NAME, "--trace", str(trace))

    def motors() -> list[Any]:
        return [entry.motors for entry in read_trace(trace)]

    with closing(Operator(broker.port, "pebble/robots/minilamp")) as operator:
        assert until(lambda: len(operator.on("outgoing/online")) > 1, 15), program.err
        operator.send("incoming/drive-values", {"z": 1.0})
        assert until(lambda: motors() == [(1.0, 1.0), (0.0, 0.0)], 5)
        began, ended = read_trace(trace)
        assert 0.8 <= (ended.ns - began.ns) / 1e9 <= 1.2  # after the last command
        assert f"connected to the broker at {address}" in program.err
        identity = operator.on("outgoing/capabilities")[-1].json["value"]["identity"]
        assert identity == {"system": "pebble", "type": "robots", "id": "minilamp", "name": NAME}
        operator.send("incoming/drive-values", {"z": 1.0})
        assert until(lambda: motors()[-1] == (1.0, 1.0))
        program.process.send_signal(signal.SIGTERM)
        signalled = time.monotonic()
        assert program.process.wait(10) == 0
        assert time.monotonic() - signalled <= END_S
        assert motors()[-1] == (0.0, 0.0)


def test_its_files_survive_a_killed_program_which_is_published_as_offline(
    start: Any, broker: Broker, tmp_path: Path
) -> None:
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"robot": {"id": "benjr"}, "local_mqtt": {"host": "127.0.0.1", "port": broker.port}}))
    arguments = ("benjr", str(config), "--files", str(tmp_path / "board"))
    program = start(*arguments)
    with closing(Operator(broker.port, "pebble/robots/benjr")) as operator:

        def became(metric: str, **fields: Any) -> bool:
            """Wait until the newest message has these fields."""
            return until(
                lambda: any(fields.items() <= one.json.items() for one in operator.on(f"outgoing/{metric}")[-1:]), 15
            )

        assert became("estop/mcu", latched=False), program.err
        operator.send("incoming/estop", {"stop": "00000000000000aa"})
        assert became("estop/mcu", latched=True, persisted=True)
        program.process.kill()
        program.process.wait()
        assert became("online", t=0, online=False)
        start(*arguments)
        assert became("estop/mcu", latched=True, count=0, recent=["00000000000000aa"])


def test_a_fleet_takes_turns_of_kinds_shows_its_status_and_ends_in_order(start: Any, broker: Broker) -> None:
    with closing(Operator(broker.port, "pebble/robots")) as operator:
        program = start("fleet", f"mqtt://127.0.0.1:{broker.port}", "-n", "3")
        assert until(lambda: b"3 robots: connected" in program.out, 20), program.err
    program.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    assert program.process.wait(10) == 0
    assert time.monotonic() - began < 2.0
    assert "3 of 3 online" in program.err + program.out.decode()
    assert {"minilamp-001", "benjr-001", "minilamp-002"} <= {one.topic.split("/")[2] for one in operator.seen}
    assert "Traceback" not in program.err


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("fleet", "http://x"), "--broker must be mqtt://"),
        (("minilamp", "mqtt://ann:secret@x"), "holds a password"),
        (("benjr", "nowhere.json"), "nowhere.json"),
        (("fleet", "mqtt://127.0.0.1", "-n", "1001"), "1000"),
        (("minilamp", "mqtt://127.0.0.1:port"), "--broker"),
        (("minilamp", "mqtt://127.0.0.1", "a/b"), "robot.id"),
        (("benjr", "mqtts://127.0.0.1"), "memory"),
    ],
)
def test_what_makes_no_sense_is_one_line(options: tuple[str, ...], named: str) -> None:
    kind, broker, *more = options
    with pytest.raises(PebbleError) as error:
        app.run(["sim", kind, "--broker", broker, *more])
    assert named in str(error.value)
    assert "secret" not in str(error.value)
    assert len(str(error.value).splitlines()) == 1
