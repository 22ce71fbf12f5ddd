"""Many robots in one process: who they are, and that each obeys its own operator only."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from typing import Self

import pytest

from pebble import cli
from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.fleet import MOST, members
from tests.support import ROOT, Broker, Child, free_port, until


class TestMembers:
    def test_kinds_take_turns_and_are_counted(self) -> None:
        assert [(kind, identity.id) for kind, identity in members(3)] == [
            ("minilamp", "minilamp-001"),
            ("benjr", "benjr-001"),
            ("minilamp", "minilamp-002"),
        ]
        assert [identity.base for _, identity in members(2, ["benjr"])] == [
            "pebble/robots/benjr-001",
            "pebble/robots/benjr-002",
        ]

    @pytest.mark.parametrize(
        ("count", "kinds", "named"), [(0, ["benjr"], "0"), (MOST + 1, ["benjr"], str(MOST)), (1, ["goob"], "goob")]
    )
    def test_what_makes_no_sense_is_named(self, count: int, kinds: list[str], named: str) -> None:
        with pytest.raises(ConfigError, match=named):
            list(members(count, kinds))


class Command:
    """One ``pebble sim`` as a process; what it writes, it writes into a file."""

    def __init__(self, file: Path, *arguments: str) -> None:
        self._file = file
        command = [sys.executable, "-m", "pebble.cli", "sim", *arguments]
        with file.open("wb") as out:
            self.process = Child(command, cwd=ROOT, stdout=out, stderr=out)

    @property
    def output(self) -> str:
        return self._file.read_text()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def test_the_program_shows_the_status_of_its_robots_and_ends_in_order(broker: Broker, tmp_path: Path) -> None:
    with Command(tmp_path / "out", "fleet", "-n", "3", "--broker", f"mqtt://127.0.0.1:{broker.port}") as command:
        assert until(lambda: "3 robots: connected" in command.output, 20), command.output
        command.process.send_signal(signal.SIGTERM)
        began = time.monotonic()
        assert command.process.wait(10) == 0
        assert time.monotonic() - began < 2.0
        assert "3 of 3 online" in command.output
        assert "Traceback" not in command.output


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("fleet", "--broker", "http://x"), "--broker must be mqtt://"),
        (("minilamp", "--broker", "mqtt://ann:secret@x"), "holds a password"),
        (("minilamp", "--broker", "zenoh:/tmp"), "--broker must be mqtt://"),
        (("benjr", "--broker", "nowhere.json"), "nowhere.json"),
        (("fleet", "-n", "1001", "--broker", "mqtt://127.0.0.1"), "1000"),
        (("fleet", "--kind", "goob", "--broker", "mqtt://127.0.0.1"), "goob"),
    ],
)
def test_a_wrong_command_line_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], named: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["pebble", "sim", *arguments])
    assert cli.main() != 0
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1
    assert "secret" not in err


def test_a_config_names_broker_and_robot(tmp_path: Path) -> None:
    port = free_port()
    config = tmp_path / "lamp.json"
    config.write_text(
        f'{{"robot": {{"id": "lamp", "type": "towers"}}, "local_mqtt": {{"host": "127.0.0.1", "port": {port}}}}}'
    )
    with Command(tmp_path / "out", "minilamp", "--broker", str(config)) as command:
        assert until(lambda: "cannot reach" in command.output, 15), command.output
        assert f"pebble/towers/lamp connects to the broker at 127.0.0.1:{port}" in command.output
        assert "Connection refused" in command.output
