"""The comparison of emergency stops without robots: when wheels are at rest, cells, the assessment and the driver."""

import io
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import Case, Measuring, Round
from pebble.bench.engine import Collected, run
from pebble.bench.estop import ALL, BOARD, CONFIRMED, ESTOP, HOLD, REST, STOP, ZERO, cell_of, measure, rest
from pebble.bench.pictures import pictures
from pebble.bench.results import Cell, Results, load
from pebble.errors import PebbleError
from pebble.rig.processes import Worker, end_all
from pebble.simulation.fleet import Moved
from pebble.transports import Message, MqttSettings, QoS, create
from tests.support import Broker, until

MS = 1_000_000
AHEAD, OFF = (0.5, 0.5), (0.0, 0.0)


def moves(*changes: tuple[int, tuple[float, float]]) -> list[Moved]:
    return [Moved(ms * MS, "rover", motors) for ms, motors in changes]


def test_wheels_are_at_rest_when_both_motors_are_off() -> None:
    found = rest(moves((10, AHEAD), (20, OFF), (30, AHEAD), (52, (0.0, 0.5)), (55, OFF)), 50 * MS)
    assert found == (55 * MS, False)


def test_wheels_that_turn_again_are_noticed() -> None:
    assert rest(moves((10, AHEAD), (52, OFF), (70, AHEAD), (75, OFF)), 50 * MS) == (52 * MS, True)


def test_wheels_that_never_rest_have_no_time() -> None:
    assert rest(moves((10, AHEAD), (60, (0.4, 0.5))), 50 * MS) == (None, False)


# -- cells and assessment


def case_of(robots: str, variant: str = STOP) -> Case:
    return Case(run=ESTOP.run_of(), number=0, variant=variant, role=variant, condition={"robot": robots})


def one_round(stop_ms: float, *, again: bool = False, lost: bool = False) -> Iterator[Cell]:
    for variant, ms in ((STOP, stop_ms), (ZERO, 1.0)):
        for _ in range(2):
            twice = int(again and variant == STOP)
            yield cell_of(case_of("mqtt", variant), REST, 5 * MS, round((5 + ms) * MS), again=twice)
    yield cell_of(case_of(ALL), REST, 0, None if lost else round(100 * MS), again=0)
    yield cell_of(case_of("mqtt"), CONFIRMED, 0, 600 * MS)
    yield cell_of(case_of("mqtt"), HOLD, 0, 3 * MS)


class FakeRobots:
    """A stand-in for robots that remembers in which way each was stopped."""

    def __init__(self) -> None:
        self.stopped: list[tuple[str, str]] = []

    def __getattr__(self, way: str) -> Callable[[Case, str], list[Cell]]:
        def note(_case: Case, robots: str) -> list[Cell]:
            self.stopped.append((way, robots))
            return []

        return note


def test_robots_are_stopped_in_turn() -> None:
    env = FakeRobots()
    run_ = ESTOP.run_of(rounds=1)
    run_.options |= {"stops": 2, "all_stops": 1}
    assert list(measure(Round(run_, 0, env, roles=(STOP, ZERO), planted_us=lambda _: 0.0))) == []
    both = [("stop", "mqtt"), ("stop_by_zero", "mqtt"), ("stop", "zenoh"), ("stop_by_zero", "zenoh")]
    assert env.stopped[:2] == [("hold", "mqtt"), ("hold", "zenoh")]
    assert env.stopped[2:] == [*both, *both[::-1], ("hold", BOARD), ("stop", ALL)]


@pytest.mark.parametrize(("way", "measure_"), [("hold", HOLD), ("stop", CONFIRMED), ("stop_by_zero", REST)])
def test_a_stop_that_fails_is_a_lost_sample_and_the_runs_problem(way: str, measure_: str) -> None:
    env, run_ = FakeRobots(), ESTOP.run_of(rounds=1)

    def fail(_case: Case, robots: str) -> Iterator[Cell]:
        raise PebbleError(f"{robots} does not stop")
        yield

    setattr(env, way, fail)
    (lost,) = measure(Round(run_, 0, env, roles=(STOP, ZERO), planted_us=lambda _: 0.0))
    assert (lost.measure, lost.lost) == (measure_, 1)
    assert str(run_.problem) == "mqtt does not stop"
    assert ("stop", ALL) not in env.stopped


def cells(*rounds: Iterator[Cell]) -> list[Cell]:
    collected = Collected(ESTOP, [""])
    for one in rounds:
        collected.add(one)
    return collected.cells()


def assessment(found: list[Cell]) -> list[str]:
    return [str(line) for line in ESTOP.report.assessed(found)]


def test_a_cell_has_the_samples_of_each_round() -> None:
    first, second = one_round(2.0), one_round(4.0, lost=True)
    found = {(cell.measure, cell.variant, cell.conditions()): cell for cell in cells(first, second)}
    assert found[REST, STOP, "mqtt"].rounds == [[2.0, 2.0], [4.0, 4.0]]
    assert found[REST, STOP, ALL].lost == 1
    assert next(iter(found)) == (REST, STOP, "mqtt")


def test_aims_are_judged_from_enough_samples() -> None:
    lines = assessment(cells(*(one_round(2.0) for _ in range(10))))
    assert "aim: mqtt, wheels at rest, p95 at most 50 ms: met (2.00 ms)" in lines
    assert f"aim: {ALL}, wheels at rest, p95 at most 250 ms: met (100 ms)" in lines
    assert "aim: mqtt, confirmed, p95 at most 500 ms: missed (600 ms)" in lines
    assert "aim: mqtt, latched under a hold, p95 at most 1000 ms: met (3.00 ms)" in lines
    assert lines[0].startswith(f"{REST}, mqtt: emergency stop takes 2.00× the time of plain zero (99 % interval")
    assert lines[-1].endswith(": met (0 times they turned again)")


def test_few_samples_are_not_judged() -> None:
    assert all("not judged" in line for line in assessment(cells(one_round(2.0))) if "p95" in line)


def test_a_stop_that_did_not_happen_misses_its_aim() -> None:
    rounds = [*(one_round(2.0) for _ in range(9)), one_round(2.0, again=True, lost=True)]
    lines = assessment(cells(*rounds))
    assert f"aim: {ALL}, wheels at rest, p95 at most 250 ms: missed (not at all)" in lines
    assert lines[-1].endswith(": missed (2 times they turned again)")


def test_the_table_names_every_measure_within_130_columns() -> None:
    out = io.StringIO()
    Console(file=out, width=130).print(*ESTOP.report.shown(cells(one_round(2.0))))
    assert all(measure in out.getvalue() for measure in (REST, CONFIRMED, HOLD))
    assert "…" not in out.getvalue()


def test_measures_with_enough_samples_have_pictures() -> None:
    results = Results(bench="estop", cells=cells(*(one_round(2.0) for _ in range(10))))
    assert [picture.name for picture in pictures(results)] == ["estop-wheels-at-rest"]


def test_a_run_repeats_itself() -> None:
    quick, full = ESTOP.run_of(quick=True), ESTOP.run_of()
    assert " ".join(quick.command) == "pebble bench estop --rounds 2 --quick"
    assert full.rounds * full["stops"] >= 100
    assert full.rounds * full["all_stops"] >= 20
    assert full.rounds >= 10
    with pytest.raises(PebbleError, match="--rounds 0: must be at least 1"):
        ESTOP.run_of(rounds=0)


def test_results_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    swept: list[bool] = []
    measured = replace(ESTOP, measuring=Measuring(measure_round=lambda _round: one_round(2.0)))
    monkeypatch.setattr(engine, "sweep", lambda: swept.append(True))
    out = io.StringIO()
    assert run(measured.run_of(rounds=2, output=tmp_path, console=Console(file=out, width=130))) == 0
    assert swept == [True]
    assert load(tmp_path / "estop.json").cells


# -- the driver


def test_the_driver_sends_a_zero_before_and_after_its_commands(broker: Broker, tmp_path: Path) -> None:
    received: list[tuple[str, float]] = []

    def note(message: Message) -> None:
        received.append((message.topic.split("/")[2], json.loads(message.payload)["z"]))

    driver = Worker("driver", [sys.executable, "-m", "pebble.bench.clients", str(broker.port)], tmp_path / "driver.log")
    with create("mqtt", "test", MqttSettings(host="127.0.0.1", port=broker.port)) as transport:
        try:
            transport.subscribe("+/+/+/incoming/drive-values", note, qos=QoS.DELIVERED, direct=True)
            driver.send("pebble/robots/a pebble/robots/b")
            assert until(lambda: received.count(("a", 0.5)) >= 3 <= received.count(("b", 0.5)))
            driver.send("pebble/robots/b")
            assert until(lambda: received.count(("a", 0.0)) == 2)
            count = received.count(("b", 0.5))
            assert until(lambda: received.count(("b", 0.5)) > count)
        finally:
            end_all([driver])
    assert [received.count((name, 0.0)) for name in "ab"] == [2, 1]
    assert next(z for name, z in received if name == "a") == 0.0
    assert [z for name, z in received if name == "a"][-1] == 0.0
