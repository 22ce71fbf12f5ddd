"""Cells, table and assessment from readings of robots."""

import io
import subprocess
import sys

import pytest
from rich.console import Console

from pebble.bench import cost
from pebble.bench.clients import encoding_of
from pebble.bench.comparison import Case
from pebble.bench.cost import COST, CPU, IDLE, MEMORY, THREADS
from pebble.bench.engine import Collected
from pebble.bench.results import Cell
from pebble.contract.packets import Codec, Picture, PictureKind, Sound

Reading = tuple[str, dict[str, dict[str, float]], float | None]  # phase, values by measure and process, pictures


def reading(phase: str, scale: float, broker: str, pictures_per_s: float | None = None) -> Reading:
    each = {MEMORY: 10.0 * scale, CPU: 1.0 * scale, THREADS: 2.0}
    names = ("launcher", "mqtt_bridge", broker)
    return phase, {measure: dict.fromkeys(names, value) for measure, value in each.items()}, pictures_per_s


def robot(scale: float, broker: str) -> list[Reading]:
    return [reading(IDLE, scale, broker), reading("json+pcm", 2 * scale, broker, 15.0)]


def cells_of(rounds: dict[str, list[list[Reading]]]) -> list[Cell]:
    collected, run = Collected(COST, list(rounds)), COST.run_of()
    for number in range(max(map(len, rounds.values()))):
        for kind, robots in rounds.items():
            case = Case(run=run, number=number, variant=kind, role=kind, condition={})
            collected.add(cell for reading in robots[number] for cell in cost.cells_of(case, *reading))
    return collected.cells()


@pytest.fixture
def cells() -> list[Cell]:
    return cells_of(
        {"mqtt": [robot(1.0, "mosquitto"), robot(1.1, "mosquitto")], "zenoh": [robot(2.0, "zenoh_hub")] * 2}
    )


def find(cells: list[Cell], kind: str, measure: str, process: str, phase: str = IDLE) -> Cell:
    wanted = {"phase": phase, "process": process}
    (cell,) = (one for one in cells if (one.variant, one.measure, one.params) == (kind, measure, wanted))
    return cell


def test_each_round_of_a_cell_is_one_figure_of_one_robot(cells: list[Cell]) -> None:
    assert find(cells, "mqtt", "PSS", "launcher").rounds == [[10.0], [11.0]]
    assert find(cells, "zenoh", "CPU", "zenoh_hub", "json+pcm").rounds == [[4.0], [4.0]]


def test_the_sum_is_over_the_processes_of_each_robot(cells: list[Cell]) -> None:
    whole = find(cells, "mqtt", "PSS", "all")
    assert whole.rounds == [[30.0], [pytest.approx(33.0)]]
    assert whole.figures == {"processes": 3}
    assert find(cells, "zenoh", "threads", "all").rounds == [[6], [6]]


def test_a_picture_costs_the_cpu_time_of_the_whole_robot(cells: list[Cell]) -> None:
    assert find(cells, "mqtt", "CPU per picture", "all", "json+pcm").rounds[0] == [pytest.approx(60 / 15)]


def test_without_pictures_there_is_no_cpu_per_picture() -> None:
    cells = cells_of({"mqtt": [[reading("json+pcm", 1.0, "mosquitto", 0.0)]]})
    assert find(cells, "mqtt", "CPU per picture", "all", "json+pcm").rounds == [[]]


def test_the_table_has_the_processes_of_both_within_100_columns(cells: list[Cell]) -> None:
    out = io.StringIO()
    Console(file=out, width=100).print(*COST.report.shown(cells))
    shown = out.getvalue()
    assert all(name in shown for name in ("idle", "json+pcm", "launcher", "mosquitto", "zenoh_hub", "all"))
    assert "…" not in shown


def test_the_assessment_is_about_sums(cells: list[Cell]) -> None:
    printed = "\n".join(map(str, COST.report.assessed(cells)))
    assert "idle, memory: mqtt 31.5 (30.0 to 33.0) MB, zenoh 60.0 (60.0 to 60.0) MB\n" in printed
    assert "json+pcm, CPU per delivered picture: mqtt 4.20" in printed
    assert "json+pcm, pictures per second: mqtt 15.0 (15.0 to 15.0) 1/s" in printed
    assert "needs 8" in printed


def test_encodings_are_distinguished() -> None:
    pcm = Sound(Codec.PCM16LE, 1, 16_000, 320, 1, 0, b"\0" * 640).pack()
    opus = Sound(Codec.OPUS, 1, 16_000, 320, 1, 0, b"\0").pack()
    h264, jpeg = (Picture(kind, 0, 0, b"").pack() for kind in (PictureKind.H264, PictureKind.JPEG))
    assert [encoding_of(raw) for raw in (pcm, opus, h264, jpeg, b'{"a": 1}')] == ["pcm", "opus", "h264", "pbvd", "json"]


def test_the_measuring_process_does_not_import_large_libraries() -> None:
    """Otherwise part of a robot's memory would be counted as the measuring process's."""
    modules = "pebble.bench.cost, pebble.bench.engine, pebble.commands.bench"
    code = f"import sys, {modules}; print({{'numpy', 'cv2', 'av', 'zenoh'}} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
