"""Short real comparisons: real processes, real brokers, and nothing of them afterwards."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pebble.extensions.lab.bench import frames
from pebble.extensions.lab.bench.results import Cell, load
from pebble.extensions.lab.rig.processes import children
from tests.support import ROOT, gone, until


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", "frames", *options]


def measured(variant: str, seconds: float, readers: int = 1) -> Cell:
    """One real run of one case."""
    return frames.measure(variant, {"size": "320x240", "readers": readers}, seconds)


def segments(pid: int) -> set[Path]:
    """The shared memory it uses."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if line.endswith(".zenoh")}


@pytest.mark.thorough
def test_a_short_run_leaves_results_and_nothing_else(temporary: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    options = ("--quick", "--seconds", "0.3", "--output", str(folder))
    names = ["zenoh-shm", "mqtt"]
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
    assert all(name in ended.stdout for name in names)
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
def test_frames_in_shared_memory_arrive_whole_at_every_reader() -> None:
    cell = measured("zenoh-shm", 0.5, readers=2)
    assert len(cell.samples) > 10
    assert cell.total("torn") == 0
    assert cell.total("fallbacks") < len(cell.samples) / 4  # a reader without CPU time holds buffers
    assert cell.middle("memory_reader_mb") > 0
    assert children(os.getpid()) == []


def test_the_bare_copy_counts_only_the_cpu_of_the_copier() -> None:
    cell = measured("memcpy", 0.5)
    assert cell.samples
    assert cell.middle("cpu_reader") > 0
    assert "cpu_writer" not in cell.figures


def test_ctrl_c_leaves_nothing(temporary: Path, tmp_path: Path) -> None:
    bench = subprocess.Popen(
        command("--output", str(tmp_path), "--quick", "--seconds", "30", "--variants", "zenoh-shm"),
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
        command("--output", str(tmp_path), "--quick", "--seconds", "30", "--variants", "mqtt"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 3, 20)  # and the broker
        started = children(bench.pid)
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: all(map(gone, started)), 10)


def test_what_the_systems_python_runs_as_plain_files_imports_nothing_of_pebble() -> None:
    folder = ROOT / "pebble/extensions/lab/bench"
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import frames_worker; print('pebble' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True).stdout
        == "False\n"
    )
