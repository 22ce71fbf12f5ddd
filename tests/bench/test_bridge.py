"""The bridge comparison without robots: matching, cells, options, assessment and profile."""

import io
import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import MagicMock

import pytest
from rich.console import Console

from pebble.bench import bridge, engine
from pebble.bench.bridge import (
    BRIDGE,
    BRIDGE_NULL,
    BRIDGE_PROFILE,
    COMMANDS,
    CPU,
    DOWN,
    LOADED,
    UNLOADED,
    UP,
    cells_of,
    commands,
    hops,
)
from pebble.bench.bridge_operator import (
    ALL,
    HOP,
    SERVICES,
    STAND_IN,
    Arrived,
    Turn,
    arrivals,
    matched,
    wheels,
    wheels_of,
)
from pebble.bench.comparison import Case, Comparison
from pebble.bench.results import Cell, Judged, Value, load
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.robot import Robot
from pebble.services.serial_mcu_bridge.text.goob_base import Touch
from pebble.simulation.trace import Entry

MS = 1_000_000
FORWARDER, SERIAL = PARTS = tuple(SERVICES)


def lines_of(cells: list[Cell]) -> list[str]:
    return [str(one) for one in BRIDGE.report.assessed(cells)]


def test_no_two_commands_are_alike_within_hours() -> None:
    assert len({wheels(number) for number in range(100_000)}) == 100_000


def test_every_command_makes_both_wheels_turn_and_none_too_fast() -> None:
    assert all(0.1 <= side < 0.9 for number in range(0, 640_000, 997) for side in wheels(number))


def test_a_command_is_identified_by_its_speeds() -> None:
    for number in range(0, 640_000, 997):
        left, right = wheels(number)
        assert wheels_of(json.dumps({"x": (left - right) / 2, "z": (left + right) / 2}).encode()) == (left, right)


# -- a turn of driving


def test_a_command_counts_once_and_when_it_came_first() -> None:
    turn = Turn(0, 200 * MS, {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS, (0.3, 0.1): 110 * MS}, {FORWARDER: 0.002})
    trace = [
        Entry(11 * MS, "line", "M 0.100 0.100"),
        Entry(13 * MS, "line", "M 0.100 0.100"),
        Entry(62 * MS, "line", "M 0.200 0.100"),
        Entry(63 * MS, "motors", "0.200 0.100"),
        Entry(900 * MS, "line", "M 0.000 0.000"),
    ]
    down, forwarded = cells_of(case_of("mqtt", COMMANDS), turn, Arrived(arrivals(trace), [], []))
    assert (down.samples, down.figures["sent"], down.lost) == ([1.0, 2.0], 3, 1)
    assert forwarded.samples == [1000.0]  # us for each of two


def test_a_report_is_identified_by_values_that_occur_once() -> None:
    turn = Turn(100 * MS, 200 * MS, {}, {FORWARDER: 0.003})
    trace = [
        Entry(90 * MS, "said", "T a0=1 a1=1 a2=1"),
        Entry(110 * MS, "said", "T a0=2 a1=2 a2=2"),
        Entry(115 * MS, "said", "OK M"),
        Entry(120 * MS, "line", "T a0=7 a1=7 a2=7"),
        Entry(130 * MS, "said", "T a0=3 a1=3 a2=3"),
        Entry(150 * MS, "said", "T a0=4 a1=4 a2=4"),
        Entry(170 * MS, "said", "T a0=3 a1=3 a2=3"),
        Entry(190 * MS, "said", "T a0=5 a1=5 a2=5"),
        Entry(210 * MS, "said", "T a0=6 a1=6 a2=6"),
    ]
    received = [
        (ns * MS, Touch(value, value, value)) for ns, value in ((91, 1), (112, 2), (131, 3), (193, 5), (211, 6))
    ]
    _, up, forwarded = cells_of(case_of("mqtt", UNLOADED), turn, Arrived({}, matched(trace, received), received))
    assert (up.samples, up.figures["sent"]) == ([2.0, 3.0], 3)
    assert forwarded.samples == [1000.0]  # us for each of the three that were received meanwhile


def test_a_report_received_before_it_was_sent_is_another_one() -> None:
    trace = [Entry(10 * MS, "said", "T a0=1 a1=2 a2=3")]
    received = [(9 * MS, Touch(1, 2, 3)), (12 * MS, Touch(1, 2, 3)), (14 * MS, Touch(1, 2, 3))]
    assert matched(trace, received) == [(10 * MS, 12 * MS)]


# -- cells


def case_of(variant: str, load_: str) -> Case:
    run = BRIDGE.run_of()
    return Case(run=run, number=0, variant=variant, role=variant, condition={"load": load_})


def collected(rounds: Sequence[Sequence[Cell]]) -> list[Cell]:
    joined = engine.Collected(BRIDGE, BRIDGE.variants)
    for cells in rounds:
        joined.add(cells)
    return joined.cells()


def turn_of(down: Sequence[float] = (), up: Sequence[float] = (), sent: int = 1, **known: Any) -> tuple[Turn, Arrived]:
    """A result with latencies in ms."""
    turn = Turn(
        **{"began": 0, "ended": MS, "sent": {wheels(number): 0 for number in range(sent)}, "cpu_s": {}, **known}
    )
    commands_ = {wheels(number): round(ms * MS) for number, ms in enumerate(down)}
    reports: list[tuple[int, int | None]] = [(0, None)] if not up else [(0, round(ms * MS)) for ms in up]
    return turn, Arrived(commands_, reports, [])


def test_cells_have_a_list_of_samples_for_each_round() -> None:
    case = case_of("zenoh", LOADED)
    took: dict[str, Any] = {"ended": 500 * MS, "cpu_s": {ALL: 0.1}}
    first = [*cells_of(case, *turn_of([1.0], [2.0], **took)), *cells_of(case, *turn_of([1.5], **took))]
    second = cells_of(case, *turn_of([3.0], [2.5], 2, **took))
    down, up = collected([first, [*second]])
    assert (down.variant, down.measure, down.params, down.unit) == ("zenoh", DOWN, {"load": "media"}, "ms")
    assert (down.rounds, down.lost) == ([[1.0, 1.5], [3.0]], 1)
    assert (up.measure, up.rounds, up.lost) == (UP, [[2.0], [2.5]], 1)
    assert down.figures == {"sent": 4, "cpu_percent": 20.0}


def test_without_reports_there_is_one_cell() -> None:
    (cell,) = cells_of(case_of(HOP, UNLOADED), *turn_of([0.2]))
    assert (cell.rounds, cell.figures) == ([[0.2]], {"sent": 1})
    (cell,) = cells_of(case_of("mqtt", COMMANDS), *turn_of([0.2]))
    assert (cell.measure, cell.params) == (DOWN, {"load": "commands"})


def test_cpu_is_divided_by_what_was_forwarded_in_each_turn() -> None:
    case, parts = case_of("mqtt", UNLOADED), {FORWARDER: 0.007, SERIAL: 0.014}
    all_, half, none = ([*cells_of(case, *turn_of(count * [1.0], sent=count, cpu_s=parts))] for count in (70, 35, 0))
    *_, bridge_, serial = collected([all_ + half, none])
    assert (bridge_.measure, bridge_.unit, bridge_.params) == (CPU, "us", {"load": "none", "process": "bridge"})
    assert [*bridge_.rounds, *serial.rounds] == [pytest.approx([100, 200]), [], pytest.approx([200, 400]), []]


class FakeRobot:
    """A stand-in for a robot that remembers when it was driven."""

    started: ClassVar[list[tuple[str, bool, bool]]] = []
    driven: ClassVar[list[str]] = []
    work: ClassVar[list[dict[str, Any]]] = []

    def __init__(self, kind: str, *, media: bool = False, reports: bool = True) -> None:
        self.kind, self.robot = kind, self
        self.started.append((kind, media, reports))

    def __enter__(self) -> "FakeRobot":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def wait_until_ready(self) -> None:
        pass

    def drive_with_media(self, seconds: float) -> Turn:
        return self.drive(seconds)

    def drive(self, seconds: float, rate_hz: float = 20, **work: Any) -> Turn:
        self.driven.append(f"{self.kind} {seconds:g}")
        self.work.extend([work] if work else [])
        turn, self.last = turn_of([1.0], [1.0], cpu_s={} if self.kind == HOP else {FORWARDER: 0.1, SERIAL: 0.1})
        return turn

    def arrived(self, _turns: Sequence[Turn]) -> Arrived:
        return self.last


@pytest.fixture(autouse=True)
def _fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeRobot, "started", [])
    monkeypatch.setattr(FakeRobot, "driven", [])
    monkeypatch.setattr(FakeRobot, "work", [])
    monkeypatch.setattr(bridge, "driven_robot", FakeRobot)
    monkeypatch.setattr(bridge, "STARTUP_S", 0.0)
    monkeypatch.setattr(engine, "find_spec", lambda _name: None)


def ran(about: Comparison, folder: Path, code: int = 0, **given: Any) -> list[Cell]:
    assert engine.run(about.run_of(output=folder, console=Console(file=io.StringIO()), **given)) == code
    return load(folder / f"{about.name}.json").cells


def test_every_load_has_robots_of_its_own_that_take_turns(tmp_path: Path) -> None:
    cells = ran(BRIDGE, tmp_path, rounds=2, seconds=2.0, variants=[STAND_IN, "mqtt"], **{"with-media": True})
    reporting = [(kind, True, True) for kind in (STAND_IN, "mqtt", HOP)]
    silent = [(STAND_IN, False, False), ("mqtt", False, False)]
    assert FakeRobot.started == [*reporting, *silent, *silent, *reporting]
    there, back = ["paho 1", "mqtt 1", "one hop 1"], ["one hop 1", "mqtt 1", "paho 1"]
    assert FakeRobot.driven[:11] == [*there, *back, "mqtt 2", *there[:2], *back[1:]]
    assert FakeRobot.driven[11:] == [*back[1:], *there[:2], *back, *there, "mqtt 2"]
    assert {len(cell.rounds) for cell in cells} == {2}
    found = {(cell.variant, cell.measure, *cell.params.values()) for cell in cells}
    processes = [(CPU, load_, part) for load_ in (UNLOADED, COMMANDS) for part in (FORWARDER, SERIAL)]
    wanted = [(DOWN, UNLOADED), (DOWN, COMMANDS), (UP, UNLOADED), *processes]
    assert found == {
        *((kind, *one) for kind in (STAND_IN, "mqtt") for one in wanted),
        *(("mqtt", DOWN, LOADED), ("mqtt", UP, LOADED), (HOP, DOWN, UNLOADED)),
    }
    assert [cell.figures["sent"] for cell in cells if cell.params["load"] == COMMANDS and cell.measure == DOWN] == [
        4,
        4,
    ]


def test_the_null_test_drives_one_robot_in_short_turns(tmp_path: Path) -> None:
    cells = ran(BRIDGE_NULL, tmp_path, rounds=2, seconds=0.1)
    assert FakeRobot.started == [("zenoh", False, True)]
    assert FakeRobot.driven == ["zenoh 2", *12 * ["zenoh 0.05"]]  # the pilot, then three roles in two rounds
    assert [(cell.variant, cell.rounds) for cell in cells] == [
        (role, [[1.0, 1.0]] * 2) for role in ("zenoh", "zenoh again", "zenoh +20 %")
    ]
    assert {work["slowed"] for work in FakeRobot.work} == {False, True}
    assert {work["work_us"] for work in FakeRobot.work} == {200.0}  # a fifth of the usual latency


# -- the options


@pytest.mark.parametrize(
    ("about", "nonsense"),
    [
        (BRIDGE, {"variants": ["carrier-pigeon"]}),
        (BRIDGE, {"variants": []}),
        (BRIDGE, {"variants": ["mqtt", "mqtt"]}),
        (BRIDGE, {"seconds": 0.0}),
        (BRIDGE, {"rounds": 0}),
        (BRIDGE, {"seconds": math.inf}),
        (BRIDGE, {"with-media": True, "null": True}),
        (BRIDGE_NULL, {"variants": ["mqtt", "zenoh"]}),
        (BRIDGE_NULL, {"variants": [STAND_IN]}),
        (BRIDGE_PROFILE, {"variants": [STAND_IN]}),
        (BRIDGE_PROFILE, {"with-media": True}),
        (BRIDGE, {"output": Path("/dev/null/there")}),
    ],
)
def test_invalid_options_are_refused_before_anything_starts(
    about: Comparison, nonsense: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge, "driven_robot", None)
    with pytest.raises(PebbleError):
        engine.run(about.run_of(**{"output": tmp_path, "console": Console(file=io.StringIO()), **nonsense}))


@pytest.mark.parametrize("about", [BRIDGE, BRIDGE_NULL, BRIDGE_PROFILE])
def test_shared_memory_is_swept_however_it_ends(
    about: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise PebbleError("no robot today")

    swept: list[bool] = []
    monkeypatch.setattr(bridge, "driven_robot", fail)
    monkeypatch.setattr("pebble.bench.bridge.socket.socket", lambda *_: MagicMock())
    monkeypatch.setattr(engine, "sweep", lambda: swept.append(True))
    with pytest.raises(PebbleError, match="no robot today"):
        engine.run(about.run_of(rounds=1, output=tmp_path, console=Console(file=io.StringIO())))
    assert swept == [True]


def test_the_local_broker_counts_as_part_of_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    with Processes() as processes:
        robot = Robot(processes, "mqtt", ("127.0.0.1", 1))
    monkeypatch.setattr(robot, "local_broker", SimpleNamespace(pid=-2))
    monkeypatch.setattr(robot, "_started", [SimpleNamespace(pid=-3)])
    assert robot.pids() == [-3, -2]


def test_a_quick_run_is_shorter_and_given_options_replace_it() -> None:
    assert BRIDGE.run_of(quick=True)["seconds"] < BRIDGE.run_of()["seconds"]
    assert BRIDGE_NULL.run_of()["variants"] == ["zenoh"]
    command = BRIDGE_NULL.run_of(variants=["mqtt"], rounds=3).command
    assert " ".join(command) == "pebble bench bridge --rounds 3 --seconds 4 --null --variants mqtt"
    assert BRIDGE.run_of(quick=True).command[-1] == "--quick"


# -- the assessment


def cell(
    variant: str, ms: float, measure: str = DOWN, load: str = UNLOADED, rounds: int = 8, each: int = 100, lost: int = 0
) -> Cell:
    params: dict[str, Value] = {"load": load}
    figures: dict[str, Value] = {"sent": each * rounds + lost, "cpu_percent": 12.5}
    samples = [[ms, ms * 1.1] * (each // 2) for _ in range(rounds)]
    return Cell(variant=variant, params=params, measure=measure, unit="ms", rounds=samples, figures=figures)


def test_the_assessment_names_ratios() -> None:
    cells = [
        *(cell("mqtt", 0.6), cell("zenoh", 0.4), cell("mqtt", 0.5, UP), cell("zenoh", 0.5, UP)),
        *(cell("mqtt", 0.7, load=LOADED), cell("zenoh", 2.4, load=LOADED), cell(HOP, 0.1)),
    ]
    text = "\n".join(lines_of(cells))
    assert "Median, down, load none: zenoh takes 0.67× the time of mqtt" in text
    assert "Median, down, load media: zenoh takes 3.43× the time of mqtt" in text
    assert "Median, up, load none: zenoh and mqtt are equal within noise" in text


def test_a_robot_that_received_nothing_is_shown_with_what_was_lost() -> None:
    nothing = [cell("mqtt", 0.4), cell("zenoh", 0.4, each=0, lost=800), cell(HOP, 0.1)]
    assert any(row.split()[-4:] == ["–", "0", "800", "12.5"] for row in shown(nothing).splitlines() if "zenoh" in row)


def test_few_rounds_and_no_samples_are_assessed() -> None:
    few = [cell("mqtt", 0.6, rounds=7), cell("zenoh", 0.4, rounds=7), cell("zenoh", 0.4, load=LOADED, rounds=7)]
    lines = lines_of(few)
    assert any("7 rounds" in line for line in lines)
    assert lines_of([]) == []


def test_the_tables_have_the_robots_cost() -> None:
    text = shown([cell("mqtt", 0.6), cell(HOP, 0.1)])
    assert "one hop" in text
    assert "12.5" in text


def test_the_tables_have_the_cpu_of_each_process_beside_that_of_the_stand_in() -> None:
    each = [cpu(kind, us, part) for part in PARTS for kind, us in ((STAND_IN, 400.0), ("mqtt", 300.0))]
    lines = shown([cell("mqtt", 0.6), *each])
    rows = [line.split() for line in lines.splitlines() if "(" in line and "median" not in line]
    assert rows[0] == ["none", "paho", "bridge", "400", "(400", "to", "400)", "8"]
    assert rows[1] == ["mqtt", "bridge", "300", "(300", "to", "300)", "8", "0.75", "(0.75", "to", "0.75)"]
    assert rows[2][:3] == ["paho", "serial", "bridge"]


# -- ratios to the stand-in


def cpu(kind: str, us: float, part: str = FORWARDER, load: str = UNLOADED, rounds: int = 8) -> Cell:
    params: dict[str, Value] = {"load": load, "process": part}
    return Cell(variant=kind, params=params, measure=CPU, unit="us", rounds=[[us] for _ in range(rounds)])


def shown(cells: list[Cell]) -> str:
    printed = Console(file=io.StringIO(), width=120, record=True)
    for table in BRIDGE.report.shown(cells):
        printed.print(table)
    return printed.export_text()


def aims(cells: list[Cell]) -> dict[str, str]:
    """Those that are ratios: what was measured, by outcome and aim."""
    found = [
        line for line in BRIDGE.report.assessed(cells) if isinstance(line, Judged) and line.what.endswith("paho's")
    ]
    return {f"{line.outcome}: {line.what}": line.measured for line in found}


def test_commands_alone_are_judged_beside_the_stand_in() -> None:
    plain, ours = cell(STAND_IN, 1.0, load=COMMANDS), cell("zenoh", 1.02, load=COMMANDS)
    assert aims([plain, ours, cell(STAND_IN, 50.0), cell("zenoh", 1.0)]) == {
        "met: zenoh, command to the wheels, commands only, p50 at most 1.05 of paho's": "1.02 (1.02 to 1.02)",
        "missed: zenoh, command to the wheels, commands only, p99 at most 0.50 of paho's": "1.02 (1.02 to 1.02)",
    }
    assert "1.02 (1.02 to 1.02)" in shown([plain, ours])


def test_cpu_is_judged_by_process_and_only_with_reports() -> None:
    cells = [cpu(STAND_IN, 400.0), cpu("mqtt", 300.0), cpu(STAND_IN, 400.0, SERIAL), cpu("mqtt", 500.0, SERIAL)]
    assert aims([*cells, *(cpu(kind, 400.0, load=COMMANDS) for kind in (STAND_IN, "mqtt"))]) == {
        "met: mqtt, CPU per message of the bridge, commands and reports, at most 1.00 of paho's": "0.75 (0.75 to 0.75)",
        "missed: mqtt, CPU per message of the serial bridge, commands and reports, at most 1.10 of paho's": (
            "1.25 (1.25 to 1.25)"
        ),
    }


def test_a_ratio_is_judged_by_its_interval() -> None:
    noisy = cpu("mqtt", 400.0)
    noisy.rounds = [[400.0 + 40 * (-1) ** number] for number in range(8)]
    (how,) = aims([cpu(STAND_IN, 400.0), noisy])
    assert how.startswith("not judged: mqtt, CPU")
    assert aims([cpu(STAND_IN, 400.0), noisy])[how].endswith(", the interval includes the bound")
    few = aims([cpu(STAND_IN, 400.0, rounds=7), cpu("mqtt", 300.0, rounds=7)])
    assert list(few.values()) == ["0.75, 7 of 8 rounds"]
    small = aims([cell(kind, 1.0, load=COMMANDS, each=98) for kind in (STAND_IN, "mqtt")])
    assert list(small.values()) == ["1.00 (1.00 to 1.00)", "1.00 (1.00 to 1.00), too few samples in a round"]


def test_commands_that_are_lost_are_infinitely_late_in_a_ratio() -> None:
    found = aims([cell(STAND_IN, 9.0, load=COMMANDS), cell("mqtt", 1.0, load=COMMANDS, each=98, lost=16)])
    assert list(found) == [
        "met: mqtt, command to the wheels, commands only, p50 at most 1.00 of paho's",
        "missed: mqtt, command to the wheels, commands only, p99 at most 0.50 of paho's",
    ]


# -- the profile


def test_hops_are_the_times_between_stations() -> None:
    sent = {(0.1, 0.1): 0, (0.2, 0.1): 10 * MS}
    into, out = {(0.1, 0.1): 1 * MS, (0.2, 0.1): 12 * MS}, {(0.1, 0.1): 4 * MS}
    assert hops(sent, [into, out]) == [[1.0], [3.0], [4.0]]


def test_the_table_of_a_profile_has_a_row_for_each_hop() -> None:
    cells = [
        Cell(variant="mqtt", params={"hop": name}, measure="hop", unit="ms", rounds=[9 * [ms] + [9.0]])
        for name, ms in zip(bridge.HOPS["mqtt"], (0.1, 0.2, 0.3, 0.4, 0.5, 1.5), strict=True)
    ]
    (table,) = BRIDGE_PROFILE.report.shown(cells)
    assert list(table.columns[1].cells) == [*bridge.HOPS["mqtt"]]
    assert [list(table.columns[at].cells)[-1] for at in (2, 3, 5)] == ["1.50", "9.00", "10"]
    assert BRIDGE_PROFILE.report.assessed(cells) == []


def test_commands_are_found_in_the_packets_that_carry_them() -> None:
    payload = b'{"x": -0.05, "z": 0.15}'
    published = b"pebble/robots/rover/incoming/drive-values\x00{" + payload
    assert commands(_packet(40_000, 1883, published + published)) == 2 * [(40_000, 1883, (0.1, 0.2))]
    assert commands(_packet(40_000, 1883, b"drive-values: what is that?")) == []


def _packet(source: int, destination: int, payload: bytes) -> bytes:
    ip = bytes([0x45, *bytes(8), 6, *bytes(10)])
    tcp = struct.pack("!HH", source, destination) + bytes(16)
    return ip + tcp + payload
