"""The program that is a MiniLAMP or a BenJr: real processes, a real broker."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.simulation.mcu import Snapshot
from pebble.simulation.trace import read_trace
from pebble.simulation.wireless import KINDS
from tests.firmware.wireless_rig import Operator, Robots
from tests.support import ROOT, Broker, Child, free_port, until

TLS = ROOT / "tests" / "data" / "tls"
END_S = 1.0


class Program:
    """One robot as a process; what it writes goes into files."""

    def __init__(self, folder: Path, kind: str, broker: str, *options: str, **environment: str) -> None:
        self._files = folder / f"{kind}.out", folder / f"{kind}.err"
        out, err = (path.open("wb") for path in self._files)
        command = [sys.executable, "-m", "pebble.simulation.networked", "--kind", kind, "--broker", broker, *options]
        with out, err:
            self.process = Child(
                command,
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                env={**os.environ, **environment},
            )

    @property
    def out(self) -> bytes:
        return self._files[0].read_bytes()

    @property
    def err(self) -> str:
        return self._files[1].read_text()

    def snapshots(self) -> list[Snapshot]:
        return [
            msgspec.json.decode(line, type=Snapshot)
            for line in self.out.splitlines(keepends=True)
            if line[-1:] == b"\n"
        ]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


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


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_driven_and_reports_its_state(start: Any, broker: Broker, tmp_path: Path, kind: str) -> None:
    trace = tmp_path / "trace.jsonl"
    program = start(kind, f"127.0.0.1:{broker.port}", "--id", kind, "--report", "--trace", str(trace))
    with Operator(broker.port) as operator:
        assert until(lambda: operator.beating(kind, 0.0) > 1, 15), program.err
        operator.drive(kind, 0.0, 1.0)
        assert until(lambda: any(identify.board.motors != (0.0, 0.0) for identify in program.snapshots()))
        assert until(lambda: [entry.motors for entry in read_trace(trace)] == [(1.0, 1.0), (0.0, 0.0)], 5)
    last = program.snapshots()[-1]
    assert (last.board.kind, last.plugged, last.host) == (kind, True, True)
    assert last.board.pose.x_mm > 50
    changes = read_trace(trace)
    assert 0.8 <= (changes[1].ns - changes[0].ns) / 1e9 <= 1.2  # after the last command
    assert f"connected to the broker at 127.0.0.1:{broker.port}" in program.err
    capabilities = retained(broker.port, f"pebble/robots/{kind}/outgoing/capabilities")
    assert capabilities["value"]["identity"]["id"] == kind
    assert capabilities["value"]["drive"] == {
        "available": True,
        "controls": True,
        "arbitrates": True,
        "topic": f"pebble/robots/{kind}/incoming/drive-values",
    }


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_at_once_with_motors_off(
    start: Any, broker: Broker, tmp_path: Path, number: signal.Signals
) -> None:
    trace = tmp_path / "trace.jsonl"
    program = start("minilamp", f"127.0.0.1:{broker.port}", "--trace", str(trace))
    with Operator(broker.port) as operator:
        assert until(lambda: operator.beating("minilamp", 0.0) > 1, 15), program.err
        operator.drive("minilamp", 0.0, 1.0)
        assert until(lambda: (1.0, 1.0) in [entry.motors for entry in read_trace(trace)])
        program.process.send_signal(number)
        began = time.monotonic()
        assert program.process.wait(10) == 0
        assert time.monotonic() - began <= END_S
    assert [entry.motors for entry in read_trace(trace)][-2:] == [(1.0, 1.0), (0.0, 0.0)]


def test_its_files_survive_the_program(start: Any, broker: Broker, tmp_path: Path) -> None:
    arguments = ("benjr", f"127.0.0.1:{broker.port}", "--files", str(tmp_path / "board"))
    topic = "pebble/robots/benjr/outgoing/estop/mcu"
    program = start(*arguments)
    assert until(lambda: (retained(broker.port, topic) or {}).get("latched") is False, 15), program.err
    with Operator(broker.port) as operator:
        operator.send("benjr", b'{"stop": "00000000000000aa"}', metric="estop")
        assert until(lambda: retained(broker.port, topic)["persisted"] and retained(broker.port, topic)["latched"])
    first = retained(broker.port, topic)
    program.process.kill()
    program.process.wait()
    start(*arguments)
    assert until(lambda: retained(broker.port, topic)["boot"] != first["boot"], 15)
    assert retained(broker.port, topic)["latched"] is True
    assert retained(broker.port, topic)["recent"] == ["00000000000000aa"]


def test_a_killed_robot_is_published_as_offline(start: Any, broker: Broker) -> None:
    program = start("benjr", f"127.0.0.1:{broker.port}")
    online = "pebble/robots/benjr/outgoing/online"
    assert until(lambda: (retained(broker.port, online) or {}).get("online") is True, 15), program.err
    program.process.kill()
    assert until(lambda: retained(broker.port, online) == {"t": 0, "online": False})


def test_a_broker_that_is_not_there_is_named_and_waited_for(start: Any, tmp_path: Path) -> None:
    port = free_port()
    program = start("minilamp", f"localhost:{port}")
    assert until(lambda: "cannot reach" in program.err, 15)
    assert f"minilamp: cannot reach the broker at localhost:{port}: Connection refused; it keeps trying" in program.err
    broker = Broker(tmp_path, port=port)
    try:
        assert until(lambda: "connected to the broker" in program.err, 20), program.err
    finally:
        broker.kill()
    assert "Traceback" not in program.err


def test_a_login_that_is_refused_is_named(start: Any, tmp_path: Path) -> None:
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "right"], check=True, capture_output=True)
    passwords.chmod(0o644)
    broker = Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    address = f"127.0.0.1:{broker.port}"
    try:
        wrong = start("benjr", address, "--username", "ann", PEBBLE_PASSWORD="wrong")
        right = start("minilamp", address, "--username", "ann", PEBBLE_PASSWORD="right")
        assert until(lambda: "connected to" in right.err, 15), right.err
        assert until(lambda: "cannot reach" in wrong.err, 15)
        assert "refused" in wrong.err
    finally:
        broker.kill()


def test_tls(start: Any, tmp_path: Path) -> None:
    broker = Broker(tmp_path, f"certfile {TLS / 'server.crt'}", f"keyfile {TLS / 'server.key'}")
    try:
        trusting = start("minilamp", f"localhost:{broker.port}", "--ca", str(TLS / "ca.crt"))
        assert until(lambda: "connected to" in trusting.err, 20), trusting.err
        doubting = start("minilamp", f"localhost:{broker.port}", "--ca", str(TLS / "other-ca.crt"))
        assert until(lambda: "cannot reach" in doubting.err, 20)
        assert "CERTIFICATE_VERIFY_FAILED" in doubting.err
    finally:
        broker.kill()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("minilamp", "127.0.0.1:port"), "--broker"),
        (("minilamp", "127.0.0.1", "--id", "a/b"), "robot.id"),
        (("minilamp", "127.0.0.1", "--username", "ann", "--password-file", "/nowhere"), "--password-file"),
        (("minilamp", "127.0.0.1", "--ca", "/nowhere"), "/nowhere"),
        (("benjr", "127.0.0.1", "--tls"), "memory"),
    ],
)
def test_what_makes_no_sense_is_one_line(start: Any, options: tuple[str, ...], named: str) -> None:
    program = start(*options)
    assert program.process.wait(15) == 1
    assert named in program.err
    assert len(program.err.splitlines()) == 1


def test_firmware_that_fails_stops_its_motors_and_boots_anew(broker: Broker) -> None:
    with Robots("127.0.0.1", broker.port) as robots, Operator(broker.port) as operator:
        robots.wait_online()
        operator.drive("benjr", 0.0, 0.8)
        assert until(lambda: robots.moving("benjr"))
        failing = robots.robots["benjr"]
        before = failing.firmware
        before.step = lambda: 1 // 0
        assert until(lambda: failing.board.resets == 1)
        assert until(lambda: not robots.moving("benjr"))
        assert until(lambda: failing.firmware is not before and failing.online, 15), failing.problem
        assert robots.robots["minilamp"].board.resets == 0
        operator.drive("benjr", 0.0, 0.8)
        assert until(lambda: robots.moving("benjr"))
