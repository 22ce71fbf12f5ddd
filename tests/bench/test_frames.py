"""Short real comparisons: real processes, real brokers, and nothing of them afterwards."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pebble.bench import engine, frames
from pebble.bench.comparison import Case
from pebble.bench.frames import FRAMES
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError
from pebble.rig.processes import children
from tests.support import ROOT, gone, until


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", "frames", *options]


def measured(variant: str, seconds: float, size: str = "320x240", readers: int = 1, **more: Any) -> Cell:
    """One real run of one case."""
    run, condition = FRAMES.run_of(seconds=seconds), {"size": size, "readers": readers}
    (cell,) = frames.measure(Case(run=run, number=0, variant=variant, role=variant, condition=condition, **more))
    return cell


def segments(pid: int) -> set[Path]:
    """The shared memory it uses."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if line.endswith(".zenoh")}


@pytest.mark.thorough
def test_a_short_run_leaves_results_and_nothing_else(temporary: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    options = ("--quick", "--seconds", "0.3", "--output", str(folder))
    names = ["zenoh-shm", "zenoh-net", "mqtt"]
    ended = subprocess.run(
        command(*options, "--variants", ",".join(names)),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(folder / "frames.json")
    assert [cell.variant for cell in results.cells] == names
    assert all(cell.params == {"size": "640x480", "readers": 1} for cell in results.cells)
    assert all([len(samples) > 3 for samples in cell.rounds] == [True, True] for cell in results.cells)
    assert all(min(cell.samples) > 0 and cell.lost is not None and cell.lost >= 0 for cell in results.cells)
    assert [line.endswith("2 rounds: too few to judge") for line in results.assessment] == [True, True]
    assert all(line in ended.stdout for line in results.assessment)
    assert results.command[:3] == ["pebble", "bench", "frames"]
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("variant", ["zenoh-shm", "zenoh-copy"])
def test_frames_in_shared_memory_arrive_whole_at_every_reader(variant: str) -> None:
    cell = measured(variant, 0.5, readers=2)
    assert len(cell.samples) > 10
    assert cell.figures["torn"] == 0
    assert float(cell.figures["fallbacks"] or 0) < len(cell.samples) / 4  # a reader without CPU time holds buffers
    assert float(cell.figures["memory_reader_mb"] or 0) > 0
    assert children(os.getpid()) == []


def test_the_bare_copy_counts_only_the_cpu_of_the_copier() -> None:
    cell = measured("memcpy", 0.5)
    assert cell.samples
    assert cell.figures["cpu_reader"]
    assert "cpu_writer" not in cell.figures


def test_a_writer_that_is_held_up_is_seen_in_every_latency() -> None:
    cell = measured("zenoh-shm", 0.3, "64x48", slowed=True, planted_us=5000.0)
    assert min(cell.samples) >= 5000.0


def test_ctrl_c_leaves_nothing(temporary: Path, tmp_path: Path) -> None:
    bench = subprocess.Popen(
        command("--output", str(tmp_path), "--quick", "--seconds", "30", "--variants", "zenoh-copy"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 2, 20)
        started = children(bench.pid)
        assert until(lambda: all(map(segments, started)), 20)
        assert list(temporary.iterdir())
        shared = set().union(*map(segments, started))
        time.sleep(1)  # files younger than a second are not swept
        bench.send_signal(signal.SIGINT)
        assert bench.wait(20) == 130
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: all(map(gone, started)), 5)
    assert not any(segment.exists() for segment in shared)
    assert list(temporary.iterdir()) == []


def test_workers_end_with_a_killed_bench(temporary: Path, tmp_path: Path) -> None:
    bench = subprocess.Popen(
        command("--output", str(tmp_path), "--quick", "--seconds", "30", "--variants", "zenoh-net"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 2, 20)
        started = children(bench.pid)
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: all(map(gone, started)), 10)


def test_what_is_not_installed_is_left_out_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frames, "SYSTEM_PYTHON", "/nowhere/python3")
    printed = io.StringIO()
    run = FRAMES.run_of(variants=["zenoh-shm", "gstreamer-shm"], console=Console(file=printed, width=80))
    assert engine.roles_of(run) == ["zenoh-shm"]
    assert "gstreamer-shm is left out" in printed.getvalue()
    assert frames.INSTALL_GSTREAMER in printed.getvalue()


@pytest.mark.parametrize(
    "given",
    [
        {"variants": ["zenoh"]},
        {"seconds": 0.0},
        {"seconds": float("nan")},
        {"rounds": 1},
        {"variants": []},
        {"variants": ["mqtt", "mqtt"]},
        {"output": Path("/dev/null/x")},
    ],
)
def test_invalid_options_are_refused_before_anything_starts(given: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(PebbleError):
        engine.run(FRAMES.run_of(**{"output": tmp_path, **given}, console=Console(file=io.StringIO())))


def test_the_command_line_of_results_repeats_them() -> None:
    assert " ".join(FRAMES.run_of(quick=True, variants=["mqtt"]).command) == (
        "pebble bench frames --seconds 0.5 --rounds 2 --variants mqtt --quick"
    )


def test_what_the_systems_python_runs_as_plain_files_imports_nothing_of_pebble() -> None:
    folder = ROOT / "pebble" / "bench"
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import frames_worker; print('pebble' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True).stdout
        == "False\n"
    )
