"""Many robots in one process: who they are, that each obeys its own operator only, and what a fleet is measured by."""

from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Self

import pytest
from rich.console import Console

from pebble import cli
from pebble.bench import engine
from pebble.bench.comparison import Case, Measuring
from pebble.bench.fleet import FLEET, STEPS, cell_of, latencies_ms, longest_gap_s, measure
from pebble.bench.results import load
from pebble.errors import ConfigError, PebbleError
from pebble.simulation.fleet import MOST, Moved, members
from tests.support import ROOT, Broker, Child, free_port, until


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


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


SENT = [number * 100_000_000 for number in range(20)]  # 10 Hz


class TestLatencies:
    def moves(self, late_ns: int, without: int = -1) -> list[Moved]:
        return [
            Moved(at + late_ns, "r", tuple(map(float, STEPS[number % len(STEPS)])))
            for number, at in enumerate(SENT)
            if number != without
        ]

    def test_every_command_is_distinguished(self) -> None:
        assert latencies_ms({"r": SENT}, {"r": self.moves(3_000_000)}) == [3.0] * 20

    def test_also_when_it_is_slower_than_the_next_one_is_sent(self) -> None:
        assert latencies_ms({"r": SENT}, {"r": self.moves(250_000_000)}) == [250.0] * 20

    def test_a_lost_one_is_missing_and_no_other_takes_its_place(self) -> None:
        assert latencies_ms({"r": SENT}, {"r": self.moves(3_000_000, without=7)}) == [3.0] * 19

    def test_a_robot_that_does_not_move_has_none(self) -> None:
        assert latencies_ms({"r": SENT}, {}) == []

    def test_no_two_commands_in_a_row_ask_for_the_same(self) -> None:
        assert len(set(STEPS)) == len(STEPS)


def test_a_robot_that_falls_silent_is_missed_until_the_end() -> None:
    second = 1_000_000_000
    alive, dead = [number * second for number in range(1, 10)], [second, 2 * second]
    assert longest_gap_s([alive], 0, 10 * second) == 1.0
    assert longest_gap_s([alive, dead], 0, 10 * second) == 8.0
    assert longest_gap_s([alive, []], 0, 10 * second) == 10.0


def test_a_quick_fleet_is_small_and_its_command_shows_it() -> None:
    quick, full = FLEET.run_of(quick=True, seconds=2.0), FLEET.run_of()
    assert (quick["robots"], quick["seconds"]) == (30, 2.0)
    assert " ".join(quick.command) == "pebble bench fleet --robots 30 --seconds 2 --quick"
    assert (full["robots"], full["seconds"]) == (200, 60.0)


def case_of(**given: object) -> Case:
    return Case(run=FLEET.run_of(**given), number=0, variant="mqtt", role="mqtt", condition={})


@pytest.mark.thorough
def test_a_small_fleet_is_measured() -> None:
    """Whole: a broker, ten robots, an operator; with bounds that hold on a busy machine too."""
    (cell,) = measure(case_of(robots=10, seconds=5.0))
    assert cell.figures["sent"] == 500
    assert cell.lost is not None
    assert cell.lost <= 0.8 * 500  # overtaken, where a busy machine let several wait
    assert 0.2 < cell.single("longest_gap_s") < 2.0  # of heartbeats at 4 Hz
    assert cell.percentile(50) < 200
    assert {"cpu_broker", "cpu_fleet", "cpu_operator"} <= cell.figures.keys()
    assert 0 < cell.figures["mb_per_robot"] < 20


def test_what_cannot_be_measured_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for bad in ({"robots": MOST + 1}, {"seconds": 0.0}, {"output": tmp_path / "file" / "no"}):
        with pytest.raises(PebbleError):
            engine.run(FLEET.run_of(**bad))


def test_figures_are_shown_and_written(tmp_path: Path) -> None:
    second = 1_000_000_000
    heartbeats = [[number * second // 4 for number in range(5)], [number * second // 4 for number in range(9)]]
    sent = {"minilamp-001": [0, second], "benjr-001": [0]}
    answer = {"sent": sent, "late": 0, "heartbeats": heartbeats}
    moves = {name: [Moved(ms * 1_000_000, name, (1.0, 1.0))] for name, ms in (("minilamp-001", 1), ("benjr-001", 9))}
    measure = Measuring(measure=lambda case: [cell_of(case, answer, moves, {"fleet": 1.0, "mb": 8.0})])
    measured = replace(FLEET, measuring=measure)
    out = StringIO()
    assert engine.run(measured.run_of(robots=2, output=tmp_path, console=Console(file=out, width=120))) == 0
    # p50 … max, n, lost, sent, late
    assert re.search(r"2 +10 Hz +1.00 +9.00 +9.00 +9.00 +2 +1 +3 +0 ", out.getvalue())
    assert load(tmp_path / "fleet.json").cells[0].rounds == [[1.0, 9.0]]


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
        (("minilamp", "--broker", "zenoh:/tmp"), "MQTT only"),
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
