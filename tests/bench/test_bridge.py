"""What is made of the driving of whole robots: matching, adding up, and telling. No robot is started here."""

import io
import json
import math
import struct
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from rich.console import Console

from pebble.bench import bridge, bridge_null, bridge_profile, bridge_report
from pebble.bench.bridge_drive import Found, Stretch, arrivals, found_of, matched, settled
from pebble.bench.bridge_hop import HOP
from pebble.bench.bridge_operator import wheels, wheels_of
from pebble.bench.bridge_plan import Mode, Plan, plan
from pebble.bench.bridge_robot import Robot
from pebble.bench.bridge_tally import DOWN, LOADED, UNLOADED, UP, Tally
from pebble.bench.bridge_wire import _stamp, commands
from pebble.bench.results import Cell, Value
from pebble.errors import PebbleError
from pebble.services.serial_mcu_bridge.goob_base import Touch
from pebble.simulation.trace import Entry

MS = 1_000_000


def test_no_two_commands_are_alike_within_hours() -> None:
    assert len({wheels(number) for number in range(100_000)}) == 100_000


def test_every_command_makes_both_wheels_turn_and_none_too_fast() -> None:
    assert all(0.1 <= side < 0.9 for number in range(0, 640_000, 997) for side in wheels(number))


def test_a_command_is_known_by_what_it_says() -> None:
    for number in range(0, 640_000, 997):
        left, right = wheels(number)
        assert wheels_of(json.dumps({"x": (left - right) / 2, "z": (left + right) / 2}).encode()) == (left, right)


# -- a stretch of driving


def test_a_command_counts_once_and_when_it_came_first() -> None:
    sent = {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS, (0.3, 0.1): 110 * MS}
    trace = [
        Entry(11 * MS, "line", "M 0.100 0.100"),
        Entry(13 * MS, "line", "M 0.100 0.100"),
        Entry(62 * MS, "line", "M 0.200 0.100"),
        Entry(63 * MS, "motors", "0.200 0.100"),
        Entry(900 * MS, "line", "M 0.000 0.000"),
    ]
    found = found_of(Stretch(0, 200 * MS, sent), arrivals(trace), [])
    assert (found.down, found.sent) == ([1.0, 2.0], 3)


def test_a_report_is_known_by_its_values_if_they_are_said_once() -> None:
    stretch = Stretch(100 * MS, 200 * MS, {})
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
    heard = [(ns * MS, Touch(value, value, value)) for ns, value in ((91, 1), (112, 2), (131, 3), (193, 5), (211, 6))]
    found = found_of(stretch, {}, matched(trace, heard))
    assert (found.up, found.reports) == ([2.0, 3.0], 3)


def test_what_was_heard_before_it_was_said_is_another_report() -> None:
    trace = [Entry(10 * MS, "said", "T a0=1 a1=2 a2=3")]
    heard = [(9 * MS, Touch(1, 2, 3)), (12 * MS, Touch(1, 2, 3)), (14 * MS, Touch(1, 2, 3))]
    assert matched(trace, heard) == [(10 * MS, 12 * MS)]


def test_waiting_is_over_when_the_last_have_arrived() -> None:
    stretch = Stretch(0, 100 * MS, {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS})
    first, last = {(0.1, 0.1): 11 * MS}, {(0.2, 0.1): 61 * MS}
    assert not settled(stretch, first, [])
    assert settled(stretch, last, [])
    assert settled(stretch, last, [(20 * MS, None), (90 * MS, 91 * MS), (110 * MS, None)])
    assert not settled(stretch, last, [(20 * MS, 21 * MS), (90 * MS, None)])


# -- adding up


def test_cells_have_a_list_of_samples_for_each_round() -> None:
    tally = Tally("zenoh", LOADED)
    stretches = [Stretch(0, 500 * MS, {}, cpu_s=0.1), Stretch(600 * MS, 1100 * MS, {}, cpu_s=0.1)]
    tally.add_round(stretches, [Found([1.0], [2.0], 1, 1), Found([1.5], [], 1, 1)], {"frames": 30, "video": 15})
    tally.add_round(stretches, [Found([3.0], [2.5], 2, 1)], {"frames": 28, "video": 15})
    down, up = tally.cells()
    assert (down.variant, down.measure, down.params, down.unit) == ("zenoh", DOWN, {"load": "media"}, "ms")
    assert (down.rounds, down.lost) == ([[1.0, 1.5], [3.0]], 1)
    assert (up.measure, up.rounds, up.lost) == (UP, [[2.0], [2.5]], 1)
    assert down.figures == {"sent": 4, "cpu_percent": 20.0, "frames_per_s": 29.0, "video_per_s": 15.0}


def test_where_nobody_reports_there_is_one_cell() -> None:
    tally = Tally(HOP, reports=False)
    tally.add_round([Stretch(0, MS, {})], [Found([0.2], sent=1)])
    (cell,) = tally.cells()
    assert (cell.rounds, cell.figures) == ([[0.2]], {"sent": 1})


# -- the plan


@pytest.mark.parametrize(
    "nonsense",
    [
        Plan(kinds=["carrier-pigeon"]),
        Plan(kinds=[]),
        Plan(kinds=["mqtt", "mqtt"]),
        Plan(seconds=0.0),
        Plan(rounds=0),
        Plan(seconds=math.inf),
        Plan(mode=Mode.NULL),
        Plan(output=Path("/dev/null/there")),
    ],
)
def test_nonsense_is_refused_before_anything_starts(nonsense: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (bridge, bridge_null, bridge_profile):
        monkeypatch.setattr(module, "Driven", None)
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
    monkeypatch.setattr(module, "Driven", fail)
    monkeypatch.setattr(module, "sweep", lambda: swept.append(True))
    with pytest.raises(PebbleError, match="no robot today"):
        module.run(plan(mode, rounds=1, output=tmp_path), Console(file=io.StringIO()))
    assert swept == [True]


def test_the_broker_on_the_robot_is_the_robots_as_a_hub_is(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot("mqtt", media=False)
    brokers = [SimpleNamespace(program=SimpleNamespace(pid=pid)) for pid in (-1, -2)]
    monkeypatch.setattr(robot, "_brokers", brokers)
    monkeypatch.setattr(robot, "_launcher", SimpleNamespace(pid=-3))
    assert robot.pids() == [-3, -2]


def test_the_impatient_have_fewer_and_what_is_given_counts() -> None:
    assert plan(Mode.MEDIA, quick=True).seconds < plan(Mode.MEDIA).seconds
    assert plan(Mode.NULL).kinds == ("zenoh",)
    assert plan(Mode.NULL, kinds=["mqtt"], rounds=3).command() == [
        *("pebble", "bench", "bridge", "--null", "--rounds", "3", "--seconds", "4", "--variants", "mqtt")
    ]
    assert plan(Mode.COMPARE, quick=True).command()[-1] == "--quick"


# -- telling


def cell(
    variant: str, ms: float, measure: str = DOWN, load: str = UNLOADED, rounds: int = 8, each: int = 100, lost: int = 0
) -> Cell:
    params: dict[str, Value] = {"load": load}
    figures: dict[str, Value] = {"sent": each * rounds + lost, "cpu_percent": 12.5}
    samples = [[ms, ms * 1.1] * (each // 2) for _ in range(rounds)]
    return Cell(variant=variant, params=params, measure=measure, unit="ms", rounds=samples, figures=figures)


def test_the_verdict_names_winners_media_floor_and_aims() -> None:
    cells = [
        *(cell("mqtt", 0.6), cell("zenoh", 0.4), cell("mqtt", 0.5, UP), cell("zenoh", 0.5, UP)),
        *(cell("mqtt", 0.7, load=LOADED), cell("zenoh", 2.4, load=LOADED), cell(HOP, 0.1)),
    ]
    text = "\n".join(bridge_report.verdict(cells))
    assert "Median, command to the wheels: zenoh is faster than mqtt: 0.67" in text
    assert "Median, command to the wheels, media flowing: zenoh is slower than mqtt: 3.43" in text
    assert "zenoh and mqtt are equal within noise" in text
    assert "zenoh, command to the wheels, p99: 0.44 ms, with media 2.64 ms; the robot with media is slower" in text
    assert "takes 0.10 ms; mqtt 0.50 ms more, zenoh 0.30 ms more." in text
    assert "aim: mqtt, command to the wheels, p50 at most 0.7 ms: met (0.60 ms)" in text


def test_a_missed_aim_is_told_with_how_much() -> None:
    last = bridge_report.verdict([cell("zenoh", 2.0)])[-1]
    assert last == "aim: zenoh, command to the wheels, p99 at most 2 ms: missed by 0.20 ms (2.20 ms)"


def test_what_never_arrived_took_longer_than_anything() -> None:
    *_, median, slowest = bridge_report.verdict([cell("zenoh", 0.4, lost=9)])
    assert median.endswith("p50 at most 0.7 ms: met (0.44 ms)")
    assert slowest.endswith("p99 at most 2 ms: missed (not within 1 s)")


def test_a_robot_that_heard_nothing_missed_its_aims() -> None:
    lines = bridge_report.verdict([cell("mqtt", 0.4), cell("zenoh", 0.4, each=0, lost=800), cell(HOP, 0.1)])
    assert "zenoh, command to the wheels: 100.0 % of 800 were overtaken, or did not arrive within 1 s." in lines
    assert "aim: zenoh, command to the wheels, p50 at most 0.7 ms: missed (not within 1 s)" in lines


@pytest.mark.parametrize(("lost", "told"), [(4, False), (5, True)])
def test_loss_is_said_where_it_is_more_than_a_stray_one(lost: int, told: bool) -> None:
    lines = bridge_report.verdict([cell("zenoh", 0.4, load=LOADED, lost=lost)])
    line = f"zenoh, command to the wheels, media flowing: 0.6 % of {800 + lost} were overtaken"
    assert any(found.startswith(line) for found in lines) is told


def test_few_rounds_and_nothing_at_all_can_be_told_too() -> None:
    few = [cell("mqtt", 0.6, rounds=7), cell("zenoh", 0.4, rounds=7), cell("zenoh", 0.4, load=LOADED, rounds=7)]
    lines = bridge_report.verdict(few)
    assert any("7 rounds" in line for line in lines)
    assert lines[-1] == "aim: zenoh, command to the wheels, p99 at most 2 ms: not judged (0.44 ms)"
    assert bridge_report.verdict([]) == []


def test_a_percentile_is_judged_only_where_something_lies_beyond_it() -> None:
    cells = [cell("zenoh", 0.4, each=36), cell("zenoh", 2.4, load=LOADED, each=98)]
    lines = bridge_report.verdict(cells)
    assert "zenoh, command to the wheels, p99: 0.44 ms, with media 2.64 ms" in lines
    assert [line.partition(" ms: ")[2] for line in lines[-2:]] == ["met (0.40 ms)", "not judged (0.44 ms)"]


def test_the_tables_have_the_robots_cost() -> None:
    said = io.StringIO()
    bridge_report.show([cell("mqtt", 0.6), cell(HOP, 0.1)], Console(file=said, width=120))
    assert "one hop" in said.getvalue()
    assert "12.5" in said.getvalue()


# -- the profile


def test_hops_are_the_times_between_stations() -> None:
    sent = {(0.1, 0.1): 0, (0.2, 0.1): 10 * MS}
    into, out = {(0.1, 0.1): 1 * MS, (0.2, 0.1): 12 * MS}, {(0.1, 0.1): 4 * MS}
    assert bridge_profile.hops(sent, [into, out]) == [(1.0, 3.0)]


def test_the_profile_tells_which_hop_makes_the_slowest_slow() -> None:
    times: bridge_profile.Times = [*(395 * [(0.1, 0.1, 0.3)]), *(5 * [(0.1, 3.1, 1.3)])]
    assert bridge_profile.slowest(times) == 5 * [(0.1, 3.1, 1.3)]
    (line,) = bridge_profile.verdict("zenoh", times)
    assert line.startswith(
        "zenoh: of what the slowest 5 of 400 commands take longer than a typical one (4.00 ms), 75 %"
    )
    assert line.endswith("is spent in: remote broker.")
    (line,) = bridge_profile.verdict("zenoh", times[1:300] + times[-4:])
    assert line == "zenoh: 303 commands are too few to say what makes the slowest slow."
    assert bridge_profile.verdict("zenoh", []) == ["zenoh: no command was followed all the way"]


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
