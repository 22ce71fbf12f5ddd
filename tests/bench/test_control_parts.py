"""The parts of the control comparison: messages, schedule, plan, order of the slices, assessment."""

import io
import socket
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import Case, Comparison
from pebble.bench.control import cells as control
from pebble.bench.control.cells import CONTROL, CONTROL_NULL, VARIANTS, assessment
from pebble.bench.control.ends import (
    ONE_WAY,
    REPLIES,
    REQUESTS,
    ROUND_TRIP,
    Connection,
    Desk,
    Exchange,
    Handler,
    Sender,
    Slice,
    SliceSpec,
    condition,
    echo,
)
from pebble.bench.judging import null
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError
from pebble.rig import processes
from pebble.rig.processes import Broker, end_all
from tests.support import until


class Loop:
    """A connection to an echo in this process; ``spoil`` changes the replies."""

    def __init__(self, spoil: Callable[[bytes], list[bytes]] = lambda payload: [payload]) -> None:
        self._handlers: dict[str, Handler] = {}
        self._spoil = spoil
        self.sizes: list[int] = []
        self.connection = Connection(self.subscribe, self.publish, lambda: None)

    def subscribe(self, filter_: str, handler: Handler) -> None:
        self._handlers[filter_] = handler

    def publish(self, topic: str, payload: bytes) -> None:
        self.sizes.append(len(payload))
        for one in self._spoil(payload) if topic.startswith(f"{REPLIES}/") else [payload]:
            self._handlers[topic](topic, one, 0)


def lines_of(cells: list[Cell]) -> list[str]:
    return [str(one) for one in assessment(cells)]


def shown(cells: list[Cell]) -> str:
    """The tables."""
    printed = io.StringIO()
    Console(file=printed, width=100).print(*CONTROL.report.shown(cells))
    return printed.getvalue()


def run(loop: Loop, spec: SliceSpec) -> tuple[int, int]:
    """How many messages counted, and how many of them returned."""
    ticks = iter(range(0, 10**9, 1000))
    clock = lambda: next(ticks)  # noqa: E731
    echo(loop.connection, "me", clock)
    sender = Sender(loop.connection, "me", clock, Desk())
    assert sender.warm_up(2, 5.0)
    done = sender.run(spec)
    assert all(one.t1 < one.t2 < one.t3 < one.t4 for one in done.exchanges)
    return done.sent, len(done.exchanges)


def test_a_slice_counts_what_it_sends_after_the_first_tenth_of_a_second() -> None:
    loop = Loop()
    assert run(loop, SliceSpec(size=64, rate=500, seconds=0.1)) == (50, 50)
    assert len(loop.sizes) == 2 * (2 + 50 + 50)


@pytest.mark.parametrize("size", [40, 1024])
def test_messages_have_the_size_that_was_asked_for_both_ways(size: int) -> None:
    loop = Loop()
    run(loop, SliceSpec(size=size, rate=500, seconds=0.02))
    assert set(loop.sizes[4:]) == {size}


@pytest.mark.parametrize(("slowed", "least"), [(False, 0), (True, 2_000_000)])
def test_the_slowed_one_works_between_its_stamp_and_its_publish_call(slowed: bool, least: int) -> None:
    loop = Loop()
    echo(loop.connection, "me", time.monotonic_ns)
    sender = Sender(loop.connection, "me", time.monotonic_ns, Desk())
    done = sender.run(SliceSpec(size=40, rate=100, seconds=0.05, work_us=2000, slowed=slowed))
    assert min(one.t2 - one.t1 for one in done.exchanges) >= least


def test_duplicates_count_once_and_foreign_messages_do_not() -> None:
    loop = Loop(lambda payload: [b"hello", payload, payload])
    assert run(loop, SliceSpec(size=40, rate=1000, seconds=0.05)) == (50, 50)


def test_a_foreign_request_is_not_echoed() -> None:
    loop = Loop()
    echo(loop.connection, "me", lambda: 0)
    loop.publish(f"{REQUESTS}/me", b"hello")
    assert loop.sizes == [5]  # the request


def test_the_default_has_sixty_cells_and_the_quick_one_twelve() -> None:
    run = CONTROL.run_of()
    assert len(control.conditions(run)) * len(run["variants"]) == 60
    run = CONTROL.run_of(quick=True)
    assert len(control.conditions(run)) * len(run["variants"]) == 12
    assert {one["load"] for one in control.conditions(run)} == {"none", "media"}


def test_what_is_asked_for_is_what_is_run_and_remembered() -> None:
    given: dict[str, Any] = {"variants": ["mqtt"], "sizes": [40], "rates": [20.0], "loads": ["none", "hog"]}
    run = CONTROL.run_of(**given, seconds=0.5, rounds=2)
    assert control.conditions(run) == [{"size": "40 B", "rate": "20 Hz", "load": load} for load in ("none", "hog")]
    assert run.command == [
        *("pebble", "bench", "control", "--variants", "mqtt", "--sizes", "40", "--rates", "20"),
        *("--loads", "none,hog", "--seconds", "0.5", "--rounds", "2"),
    ]
    loaded = control.conditions(CONTROL.run_of(loads=["media"]))
    assert loaded == [{"size": "40 B", "rate": rate, "load": "media"} for rate in ("20 Hz", "200 Hz")]


@pytest.mark.parametrize(("size", "rate"), [(40, 200.0), (1024, 0.5), (1536, 1000.0)])
def test_a_condition_is_the_slice_that_it_names(size: int, rate: float) -> None:
    case = Case(run=CONTROL.run_of(), number=0, variant="mqtt", role="mqtt", condition=condition(size, rate))
    assert SliceSpec.of(case) == SliceSpec(size=size, rate=rate, seconds=0.35)


def test_the_null_test_runs_one_variant_in_three_roles() -> None:
    run = CONTROL_NULL.run_of(quick=True, variants=["mqtt"])
    assert engine.roles_of(run) == null.roles("mqtt")
    assert " ".join(run.command).endswith("--rounds 4 --null --quick")
    assert CONTROL_NULL.run_of().rounds >= 8


@pytest.mark.parametrize(
    "nonsense",
    [
        {"variants": ["zenoh"]},
        {"variants": ["mqtt", "mqtt"]},
        {"variants": ["mqtt", "paho"], "null": True},
        {"loads": ["heavy"]},
        {"sizes": [8]},
        {"rates": [0.0]},
        {"rates": [float("nan")]},
        {"seconds": 0.0},
        {"rounds": 0},
    ],
)
def test_invalid_options_are_refused_before_anything_starts(nonsense: dict[str, object], tmp_path: Path) -> None:
    about = CONTROL_NULL if "null" in nonsense else CONTROL
    with pytest.raises(PebbleError):
        engine.run(about.run_of(**nonsense, output=tmp_path))  # type: ignore[arg-type]


def ran(folder: Path, about: Comparison = CONTROL, **given: Any) -> tuple[int, str]:
    """The exit code and what was printed."""
    printed = io.StringIO()
    code = engine.run(about.run_of(output=folder, console=Console(file=printed, width=80), **given))
    return code, printed.getvalue()


class FakeParticipants:
    """Answers at once; the second start fails."""

    calls: ClassVar[list[tuple[str, SliceSpec, str]]] = []
    started: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, roles: tuple[str, ...]) -> None:
        self.started.append(roles)

    def __enter__(self) -> Self:
        if len(self.started) == 2:
            raise PebbleError("mqtt: echo said nothing")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Nothing was started."""

    def run(self, role: str, spec: SliceSpec, load: str) -> tuple[Slice, dict[str, float]]:
        self.calls.append((role, spec, load))
        times = [int(1000 * (100.0 + spec.slowed * spec.work_us + number)) for number in range(10)]
        exchanges = [Exchange(0, ns, ns, 2 * ns, 2 * ns - 30_000) for ns in times]
        done = Slice(trips=12, sent=10, late=0, calls_ns=[50_000] * 10, exchanges=exchanges)
        return done, {"wake_ups": 7.0, "broker_wake_ups": 3.5}


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeParticipants]:
    monkeypatch.setattr(control, "Participants", FakeParticipants)
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)  # no plots
    monkeypatch.setattr(FakeParticipants, "calls", [])
    monkeypatch.setattr(FakeParticipants, "started", [])
    return FakeParticipants


def test_every_other_round_goes_backwards_and_one_that_fails_is_left_out_for_all(
    fake: type[FakeParticipants], tmp_path: Path
) -> None:
    given: dict[str, Any] = {"variants": ["mqtt", "zenoh-p2p"], "sizes": [40], "rates": [200.0]}
    code, printed = ran(tmp_path, **given, loads=["none", "hog"], rounds=4)
    assert code == 0  # fewer rounds were requested than are needed to judge
    there = [("mqtt", "none"), ("zenoh-p2p", "none"), ("mqtt", "hog"), ("zenoh-p2p", "hog")]
    expected = [*there, *there[::-1]] * 2 + [*there[::-1], *there]
    assert [(role, load) for role, _, load in fake.calls] == expected
    assert "mqtt: echo said nothing" in printed
    results = load(tmp_path / "control.json")
    assert all(len(cell.rounds) == 3 for cell in results.cells)
    assert results.assessment[0] == "1 of 4 rounds failed and were left out; round 2: mqtt: echo said nothing"
    assert {cell.lost for cell in results.cells} == {0}
    assert "50.0 74.0 30.0 7.0 3.5" in " ".join(printed.split())


@pytest.mark.usefixtures("fake")
@pytest.mark.parametrize(("rounds", "code"), [(8, 1), (9, 0)])
def test_too_few_rounds_that_are_left_are_an_error(rounds: int, code: int, tmp_path: Path) -> None:
    given: dict[str, Any] = {"variants": ["mqtt"], "sizes": [40], "rates": [200.0], "loads": ["none"]}
    assert ran(tmp_path, **given, rounds=rounds)[0] == code


@pytest.mark.usefixtures("fake")
def test_a_round_of_several_passes_has_the_samples_of_all(tmp_path: Path) -> None:
    assert ran(tmp_path, CONTROL_NULL, rounds=1)[0] == 0
    for one in load(tmp_path / "control-null.json").cells:
        assert [len(samples) for samples in one.rounds] == [10 * CONTROL_NULL.full["passes"]]
        assert one.lost == 0


def test_all_roles_work_for_a_fifth_of_the_pilot_s_median_and_the_slowed_one_when_the_time_runs(
    fake: type[FakeParticipants], tmp_path: Path
) -> None:
    assert ran(tmp_path, CONTROL_NULL, rounds=10, variants=["mqtt"])[0] == 0
    pilot, *measured = [(role, spec) for role, spec, _ in fake.calls]
    assert pilot == ("mqtt", SliceSpec(size=40, rate=200.0, seconds=CONTROL_NULL.full["seconds"]))
    assert [spec.work_us for _, spec in measured] == pytest.approx([0.2 * 104.0] * len(measured))
    assert all(spec.slowed == null.is_slowed(role) for role, spec in measured)
    results = load(tmp_path / "control-null.json")
    assert {cell.measure for cell in results.cells} == {ONE_WAY}
    assert [aim.outcome for aim in results.aims] == ["met"]


def cell(
    variant: str,
    load: str,
    p50: float,
    *,
    measure: str = ONE_WAY,
    late: int = 0,
    lost: int = 0,
    count: int = 10,
    pictures: float | None = None,
) -> Cell:
    """``lost``: in each of ``count`` rounds."""
    rounds = [[p50 + number % 7 + 3 * round_ for number in range(100 - lost)] for round_ in range(count)]
    return Cell(
        variant=variant,
        params={"size": "40 B", "rate": "200 Hz", "load": load},
        measure=measure,
        unit="us",
        rounds=rounds,
        figures={"sent": 100 * count, "late": late, "pictures_hz": pictures},
    )


def some(p2p: float) -> list[Cell]:
    usual = {
        "paho": 24_000.0,
        "mqtt": 1000.0,
        "mqtt-nodelay": 900.0,
        "mqtt5": 905.0,
        "zenoh-p2p": p2p,
        "zenoh-hub": 800.0,
    }
    return [
        cell(name, load, usual[name] * factor, measure=measure)
        for measure in (ONE_WAY, ROUND_TRIP)
        for load, factor in (("none", 1), ("media", 3), ("hog", 1.5))
        for name in usual
    ]


def test_the_assessment_compares_with_the_better_mqtt_variant_and_names_the_aims() -> None:
    printed = lines_of(some(450.0))
    assert any(line.startswith("p50: zenoh-p2p takes 0.51× the time of mqtt-nodelay (99 %") for line in printed)
    assert any(line.startswith("p99: zenoh-p2p with media takes 0.50× the time of mqtt-nodelay") for line in printed)
    assert any(line.startswith("aim: ") and "at most 0.70: met (0.5" in line for line in printed)
    assert any(line.startswith("aim: ") and "at most 0.35: missed (0.5" in line for line in printed)
    assert any("paho takes 2" in line and "the time of mqtt-nodelay" in line for line in printed)


def test_the_assessment_reports_equal_variants_as_equal() -> None:
    printed = lines_of(some(900.0))
    assert any("equal within noise: 1.00×" in line for line in printed)
    assert [line for line in printed if line.startswith("aim: ") and "met (" in line] == []


def test_the_assessment_covers_only_what_was_measured() -> None:
    assert lines_of([cell("mqtt", "hog", 900.0)]) == []
    assert lines_of([]) == []


def test_messages_that_were_late_or_lost_are_in_the_table() -> None:
    printed = shown([cell("mqtt", "hog", 900.0, late=600, lost=1)])
    assert "hog mqtt 916 933 10/600" in " ".join(printed.split())


def test_too_few_rounds_are_not_judged_and_have_no_interval() -> None:
    few = [cell(name, "media", p50, count=7) for name, p50 in (("mqtt", 900.0), ("zenoh-p2p", 900.0))]
    assert "at most 0.35: not judged (1.00 of 7 rounds)" in lines_of(few)[-1]
    assert "1.00 (" not in shown(few)


@pytest.mark.parametrize(("lost", "outcome"), [(0, "met (0.20"), (1, "met (0.20"), (2, "missed (∞")])
def test_lost_messages_are_reported_and_fail_an_aim(lost: int, outcome: str) -> None:
    printed = lines_of([cell("mqtt", "media", 5000.0), cell("zenoh-p2p", "media", 1000.0, lost=lost)])
    assert f"at most 0.35: {outcome}" in printed[-1]


def test_too_much_lost_in_few_rounds_fails_an_aim() -> None:
    ours = cell("zenoh-p2p", "media", 1000.0)
    ours.rounds[0] = ours.rounds[0][:80]
    assert "at most 0.35: missed (0.20" in lines_of([cell("mqtt", "media", 5000.0), ours])[-1]


def test_concurrent_pictures_are_reported() -> None:
    cells = [cell("mqtt", "media", 900.0, pictures=29.9), cell("zenoh-p2p", "media", 300.0, pictures=20.0)]
    assert any(line.endswith("of 30: mqtt 29.9, zenoh-p2p 20.0") for line in lines_of(cells))


def test_the_tables_of_all_variants_fit_100_columns() -> None:
    printed = shown(some(450.0))
    assert "…" not in printed
    assert all(name in printed for name in VARIANTS)


def test_the_broker_gets_the_lines_of_its_variant(tmp_path: Path) -> None:
    broker = Broker("broker", tmp_path, VARIANTS["mqtt-nodelay"].broker)
    try:
        assert "set_tcp_nodelay true" in (tmp_path / "broker.conf").read_text().splitlines()
    finally:
        end_all([broker], 5.0)


def test_another_server_on_the_broker_s_port_is_not_the_broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        monkeypatch.setattr(processes, "free_port", lambda: stranger.getsockname()[1])
        broker = Broker("broker", tmp_path)
        assert until(lambda: broker.ended)
        with pytest.raises(PebbleError, match="broker ended with code"):
            broker.wait()
