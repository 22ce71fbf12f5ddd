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
from threading import Thread
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from pebble.commands import app
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation import networked
from pebble.extensions.lab.simulation.mcu import Snapshot
from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.wireless import KINDS
from tests.firmware.wireless_rig import Operator, Robots
from tests.support import ROOT, Broker, Child, free_port, until

TLS = ROOT / "tests" / "data" / "tls"
END_S = 1.0
NAME = 'The "lamp", naïve'  # as JSON must escape it


class Program:
    """One robot as a process; what it writes goes into files."""

    def __init__(self, folder: Path, kind: str, broker: str, *options: str, **environment: str) -> None:
        self._files = folder / f"{kind}.out", folder / f"{kind}.err"
        out, err = (path.open("wb") for path in self._files)
        command = [sys.executable, "-m", "pebble.cli", "sim", kind, "--broker", f"mqtt://{broker}", *options]
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

    def snapshots(self) -> list[Snapshot]:
        return [
            msgspec.json.decode(line, type=Snapshot)
            for line in self.out.splitlines(keepends=True)
            if line[-1:] == b"\n"
        ]


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


def test_both_are_driven_report_their_state_and_end_at_once_by_a_signal_with_motors_off(
    start: Any, broker: Broker, tmp_path: Path
) -> None:
    address = f"127.0.0.1:{broker.port}"
    traces = {kind: tmp_path / f"{kind}.jsonl" for kind in KINDS}
    programs = {kind: start(kind, address, "--name", NAME, "--report", "--trace", str(traces[kind])) for kind in KINDS}

    def motors(kind: str) -> list[Any]:
        return [entry.motors for entry in read_trace(traces[kind])]

    with Operator(broker.port) as operator:
        for kind, program in programs.items():
            assert until(lambda kind=kind: operator.beating(kind, 0.0) > 1, 15), program.err  # type: ignore[misc]
            operator.drive(kind, 0.0, 1.0)
        assert until(lambda: all(motors(kind) == [(1.0, 1.0), (0.0, 0.0)] for kind in KINDS), 5)
        for (kind, program), number in zip(programs.items(), (signal.SIGTERM, signal.SIGINT), strict=True):
            moving, *_, last = program.snapshots()
            assert (last.board.kind, last.plugged, last.host) == (kind, True, True)
            assert any(one.board.motors != (0.0, 0.0) for one in program.snapshots())
            assert last.board.pose.x_mm > 50 > moving.board.pose.x_mm
            began, ended = read_trace(traces[kind])
            assert 0.8 <= (ended.ns - began.ns) / 1e9 <= 1.2  # after the last command
            assert f"connected to the broker at {address}" in program.err
            capabilities = retained(broker.port, f"pebble/robots/{kind}/outgoing/capabilities")["value"]
            assert capabilities["identity"] == {"system": "pebble", "type": "robots", "id": kind, "name": NAME}
            assert capabilities["drive"]["topic"] == f"pebble/robots/{kind}/incoming/drive-values"
            operator.drive(kind, 0.0, 1.0)
            assert until(lambda kind=kind: motors(kind)[-1] == (1.0, 1.0))  # type: ignore[misc]
            program.process.send_signal(number)
            signalled = time.monotonic()
            assert program.process.wait(10) == 0
            assert time.monotonic() - signalled <= END_S
            assert motors(kind)[-1] == (0.0, 0.0)


def test_its_files_survive_a_killed_program_which_is_published_as_offline(
    start: Any, broker: Broker, tmp_path: Path
) -> None:
    arguments = ("benjr", f"127.0.0.1:{broker.port}", "--files", str(tmp_path / "board"))
    topic, online = (f"pebble/robots/benjr/outgoing/{metric}" for metric in ("estop/mcu", "online"))
    program = start(*arguments)
    assert until(lambda: (retained(broker.port, topic) or {}).get("latched") is False, 15), program.err
    with Operator(broker.port) as operator:
        operator.send("benjr", b'{"stop": "00000000000000aa"}', metric="estop")
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


class Running:
    """The same program on threads of this process; ``err`` is what all of them write."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.signal = SimpleNamespace(received=False)
        monkeypatch.setattr(networked, "StopSignal", lambda: self.signal)
        self._capsys, self._written = capsys, ""
        self._threads: list[Thread] = []

    def start(self, kind: str, broker: str, *options: str) -> None:
        arguments = ["sim", kind, "--broker", broker, *options]
        self._threads.append(Thread(target=app.run, args=(arguments,), daemon=True))
        self._threads[-1].start()

    @property
    def err(self) -> str:
        self._written += self._capsys.readouterr().err
        return self._written

    def end(self) -> None:
        self.signal.received = True
        for thread in self._threads:
            thread.join(10)


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Running]:
    made = Running(monkeypatch, capsys)
    yield made
    made.end()


def test_a_broker_that_is_not_there_is_named_and_waited_for(running: Running, tmp_path: Path) -> None:
    port = free_port()
    running.start("minilamp", f"mqtt://localhost:{port}")
    wanted = f"minilamp: cannot reach the broker at localhost:{port}: Connection refused; it keeps trying"
    assert until(lambda: wanted in running.err, 15), running.err
    broker = Broker(tmp_path, port=port)
    try:
        assert until(lambda: "connected to the broker" in running.err, 20), running.err
    finally:
        broker.kill()


def test_a_login_that_is_refused_is_named(running: Running, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    passwords, wrong = tmp_path / "passwords", tmp_path / "wrong"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "right"], check=True, capture_output=True)
    passwords.chmod(0o644)
    wrong.write_text("wrong")
    monkeypatch.setenv("PEBBLE_PASSWORD", "right")
    broker = Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    address = f"mqtt://ann@127.0.0.1:{broker.port}"
    try:
        running.start("benjr", address, "--password-file", str(wrong))
        running.start("minilamp", address)
        assert until(lambda: "minilamp: connected to" in running.err, 15), running.err
        assert until(lambda: "benjr: cannot reach" in running.err, 15), running.err
        assert "refused" in running.err
    finally:
        broker.kill()


def test_tls(running: Running, tmp_path: Path) -> None:
    broker = Broker(tmp_path, f"certfile {TLS / 'server.crt'}", f"keyfile {TLS / 'server.key'}")
    try:
        for name, ca in (("trusting", "ca.crt"), ("doubting", "other-ca.crt")):
            running.start("minilamp", f"mqtts://localhost:{broker.port}", name, "--ca-cert", str(TLS / ca))
        assert until(lambda: "connected to" in running.err, 20), running.err
        assert until(lambda: "cannot reach" in running.err, 20), running.err
        assert "CERTIFICATE_VERIFY_FAILED" in running.err
    finally:
        broker.kill()


@pytest.mark.parametrize(
    ("options", "named"),
    [
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
    assert len(str(error.value).splitlines()) == 1


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


def test_two_drivers_of_a_board_and_only_the_key_of_now_moves_it(start: Any, broker: Broker) -> None:
    program = start("benjr", f"127.0.0.1:{broker.port}", "--report")
    base = "pebble/robots/benjr"

    def state() -> dict[str, Any]:
        found: dict[str, Any] = retained(broker.port, f"{base}/outgoing/control/mcu") or {}
        return found

    def turns() -> bool:
        snapshots = program.snapshots()
        return bool(snapshots) and any(snapshots[-1].board.motors)

    def moves(operator: Operator, key: str) -> bool:
        operator.send("benjr", json.dumps({"z": 0.5, "key": key}))
        return turns()

    with Operator(broker.port) as operator:
        assert until(lambda: state().get("key") == "", 15)
        operator.send("benjr", '{"id": "aaaaaaaa", "by": "otto", "for_ms": 10000}', metric="control")
        assert until(lambda: state().get("by") == "otto", 5)
        old = state()["key"]
        assert until(lambda: moves(operator, old), 5, step=0.05)
        operator.send("benjr", '{"id": "bbbbbbbb", "by": "mia", "for_ms": 10000}', metric="control/take")
        assert until(lambda: state().get("by") == "mia" and not turns(), 5)
        for _ in range(20):
            assert not moves(operator, old)
            time.sleep(0.05)
        new = state()["key"]
        assert until(lambda: moves(operator, new), 5, step=0.05)
