"""Short real runs of the control comparison: real processes, brokers and hubs, and nothing of them afterwards."""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import Case, Comparison
from pebble.bench.control import far as control_far
from pebble.bench.control.cells import CONTROL, CONTROL_FAR, VARIANTS, Participants
from pebble.bench.control.ends import ONE_WAY, ROUND_TRIP, Exchange, Slice, SliceSpec
from pebble.bench.control.far import BACK, THERE, Offset
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError
from pebble.rig.processes import children
from tests.support import ROOT, Broker, Child, until

SHIFT_NS = 1_500_000_000
ECHO = f"""
import sys
from pebble.bench.control.far import serve, wall_clock
wall = wall_clock()
serve(sys.argv[1], lambda: wall() + {SHIFT_NS})
"""


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", "control", *options]


def ran(about: Comparison, folder: Path, **given: Any) -> tuple[int, str]:
    """The exit code and what was printed."""
    printed = io.StringIO()
    code = engine.run(about.run_of(output=folder, console=Console(file=printed, width=80), **given))
    return code, printed.getvalue()


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots have tests of their own."""
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)


@pytest.mark.thorough
def test_all_variants_alone_and_beside_a_busy_process(temporary: Path, tmp_path: Path) -> None:
    options = ("--sizes", "40", "--rates", "200", "--loads", "none,hog", "--seconds", "0.1", "--rounds", "1")
    ended = subprocess.run(
        command(*options, "--output", str(tmp_path / "out")),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, timeout=100,
        check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(tmp_path / "out" / "control.json")
    conditions = [(measure, load_) for measure in (ONE_WAY, ROUND_TRIP) for load_ in ("none", "hog")]
    measured = [(cell.measure, cell.params["load"], cell.variant) for cell in results.cells]
    assert measured == [(*condition, variant) for condition in conditions for variant in VARIANTS]
    assert all(0 < len(cell.samples) <= 2 * 20 and min(cell.samples) > 0 for cell in results.cells)
    assert results.command[3:] == list(options)
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
@pytest.mark.usefixtures("no_plots")
def test_pictures_flow_beside_the_messages_and_replies_take_longer_than_the_way_there(tmp_path: Path) -> None:
    code, _ = ran(
        CONTROL, tmp_path, variants=["mqtt", "zenoh-p2p"], sizes=[1024], rates=[100.0], loads=["media"], seconds=0.1,
        rounds=1,
    )  # fmt: skip
    assert code == 0
    cells = load(tmp_path / "control.json").cells
    assert [cell.variant for cell in cells] == ["mqtt", "zenoh-p2p"] * 2
    assert all(float(cell.figures["pictures_hz"] or 0) > 0 for cell in cells)
    for there, back in zip(cells[:2], cells[2:], strict=True):
        assert all(a < b for a, b in zip(there.samples, back.samples, strict=True))
        hops = [float(there.figures[name] or 0) for name in ("call_us", "fabric_us", "inbox_us")]
        assert min(hops) > 0
        assert hops[1] + hops[2] < max(back.samples)
        assert float(there.figures["wake_ups"] or 0) >= 4  # a service has at least two threads that take part


@pytest.mark.thorough
def test_ctrl_c_leaves_nothing(temporary: Path, tmp_path: Path) -> None:
    options = ("--seconds", "60", "--variants", "mqtt,zenoh-p2p", "--loads", "media", "--output", str(tmp_path / "out"))
    bench = subprocess.Popen(
        command(*options), env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 8, 30)  # two are the pictures
        started = children(bench.pid)
        assert list(temporary.iterdir())
        bench.send_signal(signal.SIGINT)
        assert bench.wait(30) == 130
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started), 10)
    assert list(temporary.iterdir()) == []


def test_a_process_that_dies_is_named() -> None:
    with Participants(["mqtt"]) as participants:
        lines = {pid: Path(f"/proc/{pid}/cmdline").read_text() for pid in children(os.getpid())}
        os.kill(next(pid for pid, line in lines.items() if "\0sender\0" in line), signal.SIGKILL)
        with pytest.raises(PebbleError, match="mqtt: sender ended with code -9"):
            participants.run("mqtt", SliceSpec(size=40, rate=100.0, seconds=0.1), "none")


# -- another machine


@pytest.fixture
def url(broker: Broker) -> str:
    return f"mqtt://127.0.0.1:{broker.port}"


@pytest.fixture
def echo(url: str) -> Iterator[Child]:
    """A process whose clock is ahead."""
    child = Child([sys.executable, "-c", ECHO, url], cwd=ROOT, stdout=subprocess.PIPE)
    assert b"until Ctrl-C" in child.stdout.readline()
    yield child
    child.kill()
    child.communicate()


@pytest.mark.usefixtures("echo", "no_plots")
def test_a_far_clock_is_found_within_its_error(url: str, tmp_path: Path) -> None:
    code, printed = ran(CONTROL_FAR, tmp_path, far=url, sizes=[40], rates=[200.0], seconds=0.3, rounds=2)
    assert code == 0
    results = load(tmp_path / "control-far.json")
    assert " ".join(results.command).endswith("--rounds 2 --far URL")  # results name no hosts
    assert "far" not in results.options
    round_trip, there, back = results.cells
    assert [len(one) for one in round_trip.rounds] == [60, 60]
    assert [cell.measure for cell in (round_trip, there, back)] == [ROUND_TRIP, THERE, BACK]
    offset, error = there.figures["clock_offset_ms"], there.figures["clock_error_ms"]
    assert isinstance(offset, float)
    assert isinstance(error, float)
    assert abs(offset - SHIFT_NS / 1e6) <= error + 0.001
    assert f"{offset:+.3f}" in printed


def test_the_echo_ends_with_ctrl_c(url: str) -> None:
    line = [sys.executable, "-m", "pebble.cli", "bench", "echo", url]
    with Child(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as echo:
        assert b"until Ctrl-C" in echo.stdout.readline()
        echo.send_signal(signal.SIGINT)
        assert echo.wait(20) == 130
        assert b"Traceback" not in echo.stderr.read()


def test_a_clock_that_is_slewed_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = control_far.wall_clock()
    before = wall()
    monkeypatch.setattr(control_far.time, "monotonic_ns", lambda: 0)
    assert wall() >= before


def test_a_missing_far_echo_is_reported(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_far, "ANSWER_S", 0.3)
    with pytest.raises(PebbleError, match="run `pebble bench echo URL` on the other machine"):
        ran(CONTROL_FAR, tmp_path, far=url)


def far_cells(exchanges: Sequence[Exchange], monkeypatch: pytest.MonkeyPatch, offset: Offset | None) -> list[Cell]:
    """The cells of one round with these exchanges."""

    class Answered:
        def run(self, _spec: SliceSpec) -> Slice:
            return Slice(trips=1, sent=1, late=0, calls_ns=[0], exchanges=list(exchanges))

    if offset is not None:
        monkeypatch.setattr(control_far, "estimate", lambda _exchanges: offset)
    run, condition = CONTROL_FAR.run_of(), {"size": "40 B", "rate": "20 Hz"}
    collected = engine.Collected(CONTROL_FAR, ["mqtt"])
    case = Case(run=run, number=0, variant="mqtt", role="mqtt", condition=condition, env=Answered())
    collected.add(control_far.measure(case))
    return collected.cells()


def shown(cells: Sequence[Cell]) -> str:
    printed = io.StringIO()
    Console(file=printed, width=100).print(*CONTROL_FAR.report.shown(cells))
    return printed.getvalue()


def test_the_two_ways_add_up_to_the_round_trip(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = far_cells([Exchange(0, 5_000_010, 5_000_017, 40)], monkeypatch, Offset(5_000_000, 5))
    round_trip, there, back = (one.samples[0] for one in cells)
    assert there == pytest.approx(10e-6)
    assert there + back == pytest.approx(round_trip)


def test_one_way_times_that_the_clocks_error_hides_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = far_cells([Exchange(0, 10, 10, 20)], monkeypatch, Offset(0, 10))
    round_trip, there, back = cells
    assert round_trip.samples == [2e-5]
    assert there.samples == back.samples == []
    assert shown(cells).count("–") == 4  # p50 and p99, there and back


def test_clocks_that_could_not_be_compared_leave_the_round_trips(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = far_cells([Exchange(0, 10, 10, 20)], monkeypatch, None)  # one is too few
    assert [cell.figures.get("clock_error_ms") for cell in cells] == [None] * 3
    assert [len(cell.samples) for cell in cells] == [1, 0, 0]
    assert shown(cells).count("–") == 4  # p50 and p99, there and back


@pytest.mark.parametrize(
    "options",
    [
        ("--far", "zenoh:/tmp"),
        ("--far", "mqtt://user:secret@127.0.0.1"),
        ("--far", "mqtt://127.0.0.1", "--loads", "media"),
        ("--sizes", "big"),
        ("--variants", "nats"),
    ],
)
def test_invalid_options_are_refused(options: tuple[str, ...]) -> None:
    ended = subprocess.run(command(*options), cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)
    assert ended.returncode == 1
    assert "secret" not in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
