"""The program that is a MiniLAMP or a BenJr: real processes, a real broker."""

from __future__ import annotations

import json
import os
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
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.lab.simulation.fleet import members
from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.wireless import KINDS
from tests.robot.operator import Operator
from tests.support import ROOT, Broker, Child, free_port, until

END_S = 1.0
NAME = 'The "lamp", naïve'  # as JSON must escape it


class Program:
    """One robot as a process; what it writes goes into files."""

    def __init__(self, folder: Path, kind: str, broker: str, *options: str, **environment: str) -> None:
        self._files = folder / f"{kind}.out", folder / f"{kind}.err"
        out, err = (path.open("wb") for path in self._files)
        command = [sys.executable, "-m", "pebble.cli", "sim", kind, "--broker", broker, *options]
        with out, err:
            self.process = Child(
                command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env={**os.environ, **environment}
            )

    @property
    def out(self) -> bytes:
        return self._files[0].read_bytes()

    @property
    def err(self) -> str:
        return self._files[1].read_text()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Any]:
    programs: list[Program] = []

    def start(*arguments: str, **environment: str) -> Program:
        programs.append(Program(tmp_path, *arguments, **environment))
        return programs[-1]

    yield start
    for program in programs:
        program.process.kill()
        program.process.wait()


def retained(port: int, topic: str) -> Any:
    """What the broker keeps there; None if nothing within a second."""
    command = ["mosquitto_sub", "-p", str(port), "-t", topic, "-C", "1", "-W", "1", "--retained-only"]
    raw = subprocess.run(command, capture_output=True).stdout
    return json.loads(raw) if raw else None


def test_both_are_driven_and_end_at_once_by_a_signal_with_motors_off(
    start: Any, broker: Broker, tmp_path: Path
) -> None:
    address = f"127.0.0.1:{broker.port}"
    url = f"mqtt://{address}"
    traces = {kind: tmp_path / f"{kind}.jsonl" for kind in KINDS}
    programs = {kind: start(kind, url, "--name", NAME, "--trace", str(traces[kind])) for kind in KINDS}

    def motors(kind: str) -> list[Any]:
        return [entry.motors for entry in read_trace(traces[kind])]

    with closing(Operator(broker.port, "pebble/robots")) as operator:
        for kind, program in programs.items():
            assert until(lambda kind=kind: len(operator.on(f"{kind}/outgoing/online")) > 1, 15), program.err  # type: ignore[misc]
            operator.send(f"{kind}/incoming/drive-values", {"z": 1.0})
        assert until(lambda: all(motors(kind) == [(1.0, 1.0), (0.0, 0.0)] for kind in KINDS), 5)
        for (kind, program), number in zip(programs.items(), (signal.SIGTERM, signal.SIGINT), strict=True):
            began, ended = read_trace(traces[kind])
            assert 0.8 <= (ended.ns - began.ns) / 1e9 <= 1.2  # after the last command
            assert f"connected to the broker at {address}" in program.err
            capabilities = retained(broker.port, f"pebble/robots/{kind}/outgoing/capabilities")["value"]
            assert capabilities["identity"] == {"system": "pebble", "type": "robots", "id": kind, "name": NAME}
            assert capabilities["drive"]["topic"] == f"pebble/robots/{kind}/incoming/drive-values"
            operator.send(f"{kind}/incoming/drive-values", {"z": 1.0})
            assert until(lambda kind=kind: motors(kind)[-1] == (1.0, 1.0))  # type: ignore[misc]
            program.process.send_signal(number)
            signalled = time.monotonic()
            assert program.process.wait(10) == 0
            assert time.monotonic() - signalled <= END_S
            assert motors(kind)[-1] == (0.0, 0.0)


def test_its_files_survive_a_killed_program_which_is_published_as_offline(
    start: Any, broker: Broker, tmp_path: Path
) -> None:
    arguments = ("benjr", f"mqtt://127.0.0.1:{broker.port}", "--files", str(tmp_path / "board"))
    topic, online = (f"pebble/robots/benjr/outgoing/{metric}" for metric in ("estop/mcu", "online"))
    program = start(*arguments)
    assert until(lambda: (retained(broker.port, topic) or {}).get("latched") is False, 15), program.err
    with closing(Operator(broker.port, "pebble/robots/benjr")) as operator:
        operator.send("incoming/estop", {"stop": "00000000000000aa"})
        assert until(lambda: retained(broker.port, topic)["persisted"] and retained(broker.port, topic)["latched"])
    first = retained(broker.port, topic)
    assert retained(broker.port, online)["online"] is True
    program.process.kill()
    program.process.wait()
    assert until(lambda: retained(broker.port, online) == {"t": 0, "online": False})
    start(*arguments)
    assert until(lambda: retained(broker.port, topic)["boot"] != first["boot"], 15)
    assert retained(broker.port, topic)["latched"] is True
    assert retained(broker.port, topic)["recent"] == ["00000000000000aa"]


def test_kinds_of_a_fleet_take_turns_and_are_counted() -> None:
    assert [(kind, identity.base) for kind, identity in members(3)] == [
        ("minilamp", "pebble/robots/minilamp-001"),
        ("benjr", "pebble/robots/benjr-001"),
        ("minilamp", "pebble/robots/minilamp-002"),
    ]
    with pytest.raises(ConfigError, match="0"):
        list(members(0))


def test_a_fleet_shows_its_status_and_ends_in_order(start: Any, broker: Broker) -> None:
    program = start("fleet", f"mqtt://127.0.0.1:{broker.port}", "-n", "3")
    assert until(lambda: b"3 robots: connected" in program.out, 20), program.err
    program.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    assert program.process.wait(10) == 0
    assert time.monotonic() - began < 2.0
    assert "3 of 3 online" in program.err + program.out.decode()
    assert "Traceback" not in program.err


def test_a_config_names_a_broker_that_is_waited_for(start: Any, tmp_path: Path) -> None:
    where = {"host": "127.0.0.1", "port": free_port()}
    config = tmp_path / "lamp.json"
    config.write_text(json.dumps({"robot": {"id": "lamp", "type": "towers"}, "local_mqtt": where}))
    program, refused = start("minilamp", str(config)), f"127.0.0.1:{where['port']}: Connection refused; it keeps trying"
    assert until(lambda: refused in program.err, 15), program.err
    assert f"pebble/towers/lamp connects to the broker at 127.0.0.1:{where['port']}".encode() in program.out
    broker = Broker(tmp_path, port=int(where["port"]))
    assert until(lambda: "connected to the broker" in program.err, 20), program.err
    broker.kill()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("fleet", "http://x"), "--broker must be mqtt://"),
        (("minilamp", "mqtt://ann:secret@x"), "holds a password"),
        (("minilamp", "zenoh:/tmp"), "--broker must be mqtt://"),
        (("benjr", "nowhere.json"), "nowhere.json"),
        (("fleet", "mqtt://127.0.0.1", "-n", "1001"), "1000"),
        (("minilamp", "mqtt://127.0.0.1:port"), "--broker"),
        (("minilamp", "mqtt://127.0.0.1", "a/b"), "robot.id"),
        (("minilamp", "mqtt://ann@127.0.0.1", "--password-file", "/nowhere"), "--password-file"),
        (("minilamp", "mqtts://127.0.0.1", "--ca-cert", "/nowhere"), "/nowhere"),
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
