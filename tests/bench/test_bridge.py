"""The bridge comparison without robots: matching, cells, plans, assessment and profile."""

import io
import json
import math
import struct
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from rich.console import Console

from pebble.bench import bridge, bridge_null, bridge_profile, bridge_report
from pebble.bench.bridge_capture import _stamp, commands
from pebble.bench.bridge_drive import Arrived, DriveSegment, all_arrived, arrivals, arrived_of, matched
from pebble.bench.bridge_one_hop import HOP
from pebble.bench.bridge_operator import wheels, wheels_of
from pebble.bench.bridge_plan import BridgePlan, Mode, plan
from pebble.bench.bridge_tally import DOWN, LOADED, UNLOADED, UP, Tally
from pebble.bench.results import Cell, Value
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.robot import Robot
from pebble.services.serial_mcu_bridge.text.goob_base import Touch
from pebble.simulation.trace import Entry

MS = 1_000_000


def lines_of(cells: list[Cell]) -> list[str]:
    return [str(one) for one in bridge_report.assessment(cells)]


def test_no_two_commands_are_alike_within_hours() -> None:
    assert len({wheels(number) for number in range(100_000)}) == 100_000


def test_every_command_makes_both_wheels_turn_and_none_too_fast() -> None:
    assert all(0.1 <= side < 0.9 for number in range(0, 640_000, 997) for side in wheels(number))


def test_a_command_is_identified_by_its_speeds() -> None:
    for number in range(0, 640_000, 997):
        left, right = wheels(number)
        assert wheels_of(json.dumps({"x": (left - right) / 2, "z": (left + right) / 2}).encode()) == (left, right)


# -- a segment of driving


def test_a_command_counts_once_and_when_it_came_first() -> None:
    sent = {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS, (0.3, 0.1): 110 * MS}
    trace = [
        Entry(11 * MS, "line", "M 0.100 0.100"),
        Entry(13 * MS, "line", "M 0.100 0.100"),
        Entry(62 * MS, "line", "M 0.200 0.100"),
        Entry(63 * MS, "motors", "0.200 0.100"),
        Entry(900 * MS, "line", "M 0.000 0.000"),
    ]
    found = arrived_of(DriveSegment(0, 200 * MS, sent), arrivals(trace), [])
    assert (found.down, found.sent) == ([1.0, 2.0], 3)


def test_a_report_is_identified_by_values_that_occur_once() -> None:
    segment = DriveSegment(100 * MS, 200 * MS, {})
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
    found = arrived_of(segment, {}, matched(trace, received))
    assert (found.up, found.reports) == ([2.0, 3.0], 3)


def test_a_report_received_before_it_was_sent_is_another_one() -> None:
    trace = [Entry(10 * MS, "said", "T a0=1 a1=2 a2=3")]
    received = [(9 * MS, Touch(1, 2, 3)), (12 * MS, Touch(1, 2, 3)), (14 * MS, Touch(1, 2, 3))]
    assert matched(trace, received) == [(10 * MS, 12 * MS)]


def test_waiting_ends_when_the_last_ones_have_arrived() -> None:
    segment = DriveSegment(0, 100 * MS, {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS})
    first, last = {(0.1, 0.1): 11 * MS}, {(0.2, 0.1): 61 * MS}
    assert not all_arrived(segment, first, [])
    assert all_arrived(segment, last, [])
    assert all_arrived(segment, last, [(20 * MS, None), (90 * MS, 91 * MS), (110 * MS, None)])
    assert not all_arrived(segment, last, [(20 * MS, 21 * MS), (90 * MS, None)])


# -- cells


def test_cells_have_a_list_of_samples_for_each_round() -> None:
    tally = Tally("zenoh", LOADED)
    segments = [DriveSegment(0, 500 * MS, {}, cpu_s=0.1), DriveSegment(600 * MS, 1100 * MS, {}, cpu_s=0.1)]
    tally.add_round(segments, [Arrived([1.0], [2.0], 1, 1), Arrived([1.5], [], 1, 1)], {"frames": 30, "video": 15})
    tally.add_round(segments, [Arrived([3.0], [2.5], 2, 1)], {"frames": 28, "video": 15})
    down, up = tally.cells()
    assert (down.variant, down.measure, down.params, down.unit) == ("zenoh", DOWN, {"load": "media"}, "ms")
    assert (down.rounds, down.lost) == ([[1.0, 1.5], [3.0]], 1)
    assert (up.measure, up.rounds, up.lost) == (UP, [[2.0], [2.5]], 1)
    assert down.figures == {"sent": 4, "cpu_percent": 20.0, "frames_per_s": 29.0, "video_per_s": 15.0}


def test_without_reports_there_is_one_cell() -> None:
    tally = Tally(HOP, reports=False)
    tally.add_round([DriveSegment(0, MS, {})], [Arrived([0.2], sent=1)])
    (cell,) = tally.cells()
    assert (cell.rounds, cell.figures) == ([[0.2]], {"sent": 1})


# -- the plan


@pytest.mark.parametrize(
    "nonsense",
    [
        BridgePlan(kinds=["carrier-pigeon"]),
        BridgePlan(kinds=[]),
        BridgePlan(kinds=["mqtt", "mqtt"]),
        BridgePlan(seconds=0.0),
        BridgePlan(rounds=0),
        BridgePlan(seconds=math.inf),
        BridgePlan(mode=Mode.NULL),
        BridgePlan(output=Path("/dev/null/there")),
    ],
)
def test_invalid_options_are_refused_before_anything_starts(
    nonsense: BridgePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (bridge, bridge_null, bridge_profile):
        monkeypatch.setattr(module, "DrivenRobot", None)
        with pytest.raises(PebbleError):
            module.run(nonsense, Console(file=io.StringIO()))


@pytest.mark.parametrize(
    ("module", "mode"), [(bridge, Mode.COMPARE), (bridge_null, Mode.NULL), (bridge_profile, Mode.PROFILE)]
)
def test_shared_memory_is_swept_however_it_ends(
    module: ModuleType, mode: Mode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise PebbleError("no robot today")

    swept: list[bool] = []
    monkeypatch.setattr(module, "DrivenRobot", fail)
    monkeypatch.setattr(module, "sweep", lambda: swept.append(True))
    with pytest.raises(PebbleError, match="no robot today"):
        module.run(plan(mode, rounds=1, output=tmp_path), Console(file=io.StringIO()))
    assert swept == [True]


def test_the_local_broker_counts_as_part_of_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    with Processes() as processes:
        robot = Robot(processes, "mqtt", ("127.0.0.1", 1))
    monkeypatch.setattr(robot, "local_broker", SimpleNamespace(pid=-2))
    monkeypatch.setattr(robot, "_started", [SimpleNamespace(pid=-3)])
    assert robot.pids() == [-3, -2]


def test_a_quick_plan_is_shorter_and_given_options_replace_it() -> None:
    assert plan(Mode.MEDIA, quick=True).seconds < plan(Mode.MEDIA).seconds
    assert plan(Mode.NULL).kinds == ("zenoh",)
    assert plan(Mode.NULL, kinds=["mqtt"], rounds=3).command() == [
        *("pebble", "bench", "bridge", "--null", "--rounds", "3", "--seconds", "4", "--variants", "mqtt")
    ]
    assert plan(Mode.COMPARE, quick=True).command()[-1] == "--quick"


# -- the assessment


def cell(
    variant: str, ms: float, measure: str = DOWN, load: str = UNLOADED, rounds: int = 8, each: int = 100, lost: int = 0
) -> Cell:
    params: dict[str, Value] = {"load": load}
    figures: dict[str, Value] = {"sent": each * rounds + lost, "cpu_percent": 12.5}
    samples = [[ms, ms * 1.1] * (each // 2) for _ in range(rounds)]
    return Cell(variant=variant, params=params, measure=measure, unit="ms", rounds=samples, figures=figures)


def test_the_assessment_names_ratios_media_floor_and_aims() -> None:
    cells = [
        *(cell("mqtt", 0.6), cell("zenoh", 0.4), cell("mqtt", 0.5, UP), cell("zenoh", 0.5, UP)),
        *(cell("mqtt", 0.7, load=LOADED), cell("zenoh", 2.4, load=LOADED), cell(HOP, 0.1)),
    ]
    text = "\n".join(lines_of(cells))
    assert "Median, command to the wheels: zenoh takes 0.67× the time of mqtt" in text
    assert "Median, command to the wheels, media flowing: zenoh takes 3.43× the time of mqtt" in text
    assert "zenoh and mqtt are equal within noise" in text
    assert "zenoh, command to the wheels, p99: 0.44 ms, with media 2.64 ms; the robot with media takes" in text
    assert "takes 0.10 ms; mqtt 0.50 ms more, zenoh 0.30 ms more." in text
    assert "aim: mqtt, command to the wheels, p50 at most 0.7 ms: met (0.60 ms)" in text


def test_a_missed_aim_is_shown_with_the_difference() -> None:
    last = lines_of([cell("zenoh", 2.0)])[-1]
    assert last == "aim: zenoh, command to the wheels, p99 at most 2 ms: missed (2.20 ms, by 0.20 ms)"


def test_lost_commands_count_as_infinitely_late() -> None:
    *_, median, slowest = lines_of([cell("zenoh", 0.4, lost=9)])
    assert median.endswith("p50 at most 0.7 ms: met (0.44 ms)")
    assert slowest.endswith("p99 at most 2 ms: missed (not within 1 s)")


def test_a_robot_that_received_nothing_missed_its_aims() -> None:
    lines = lines_of([cell("mqtt", 0.4), cell("zenoh", 0.4, each=0, lost=800), cell(HOP, 0.1)])
    assert "zenoh, command to the wheels: 100.0 % of 800 were overtaken, or did not arrive within 1 s." in lines
    assert "aim: zenoh, command to the wheels, p50 at most 0.7 ms: missed (not within 1 s)" in lines


@pytest.mark.parametrize(("lost", "shown"), [(4, False), (5, True)])
def test_loss_is_reported_above_a_threshold(lost: int, shown: bool) -> None:
    lines = lines_of([cell("zenoh", 0.4, load=LOADED, lost=lost)])
    line = f"zenoh, command to the wheels, media flowing: 0.6 % of {800 + lost} were overtaken"
    assert any(found.startswith(line) for found in lines) is shown


def test_few_rounds_and_no_samples_are_assessed() -> None:
    few = [cell("mqtt", 0.6, rounds=7), cell("zenoh", 0.4, rounds=7), cell("zenoh", 0.4, load=LOADED, rounds=7)]
    lines = lines_of(few)
    assert any("7 rounds" in line for line in lines)
    assert lines[-1] == "aim: zenoh, command to the wheels, p99 at most 2 ms: not judged (0.44 ms)"
    assert lines_of([]) == []


def test_a_percentile_is_judged_only_where_something_lies_beyond_it() -> None:
    cells = [cell("zenoh", 0.4, each=36), cell("zenoh", 2.4, load=LOADED, each=98)]
    lines = lines_of(cells)
    assert "zenoh, command to the wheels, p99: 0.44 ms, with media 2.64 ms" in lines
    assert [line.partition(" ms: ")[2] for line in lines[-2:]] == ["met (0.40 ms)", "not judged (0.44 ms)"]


def test_the_tables_have_the_robots_cost() -> None:
    printed = io.StringIO()
    bridge_report.show([cell("mqtt", 0.6), cell(HOP, 0.1)], Console(file=printed, width=120))
    assert "one hop" in printed.getvalue()
    assert "12.5" in printed.getvalue()


# -- the profile


def test_hops_are_the_times_between_stations() -> None:
    sent = {(0.1, 0.1): 0, (0.2, 0.1): 10 * MS}
    into, out = {(0.1, 0.1): 1 * MS, (0.2, 0.1): 12 * MS}, {(0.1, 0.1): 4 * MS}
    assert bridge_profile.hops(sent, [into, out]) == [(1.0, 3.0)]


def test_the_profile_names_the_hop_that_makes_the_slowest_slow() -> None:
    times: bridge_profile.Times = [*(395 * [(0.1, 0.1, 0.3)]), *(5 * [(0.1, 3.1, 1.3)])]
    assert bridge_profile.slowest(times) == 5 * [(0.1, 3.1, 1.3)]
    (line,) = bridge_profile.assessment("zenoh", times)
    assert line.startswith(
        "zenoh: of what the slowest 5 of 400 commands take longer than a typical one (4.00 ms), 75 %"
    )
    assert line.endswith("is spent in: remote broker.")
    (line,) = bridge_profile.assessment("zenoh", times[1:300] + times[-4:])
    assert line == "zenoh: 303 commands are too few to tell where the slowest lose their time."
    assert bridge_profile.assessment("zenoh", []) == ["zenoh: no command was traced all the way"]


def test_stamps_of_another_form_are_refused() -> None:
    assert _stamp([(1, 35, struct.pack("qq", 2, 5))]) == 2_000_000_005
    with pytest.raises(PebbleError, match="64-bit"):
        _stamp([(1, 35, struct.pack("ii", 2, 5))])


def test_commands_are_found_in_the_packets_that_carry_them() -> None:
    payload = b'{"x": -0.05, "z": 0.15}'
    published = b"pebble/robots/rover/incoming/drive-values\x00{" + payload
    assert commands(_frame(40_000, 1883, published + published)) == 2 * [((40_000, 1883), (0.1, 0.2))]
    assert commands(_frame(40_000, 1883, b"drive-values: what is that?")) == []
    assert commands(b"") == []


def _frame(source: int, destination: int, payload: bytes) -> bytes:
    ip = bytes([0x45, *bytes(8), 6, *bytes(10)])
    tcp = struct.pack("!HH", source, destination) + bytes(16)
    return bytes(14) + ip + tcp + payload
