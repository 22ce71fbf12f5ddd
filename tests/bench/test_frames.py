"""Short real comparisons: real processes, real brokers, and nothing of them afterwards."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import frames, frames_variants
from pebble.bench.frames import FramesPlan
from pebble.bench.frames_variants import Case, Size, parse_size
from pebble.bench.results import load
from pebble.errors import PebbleError
from pebble.rig.programs import children
from tests.support import ROOT, gone, until


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", "frames", *options]


def segments(pid: int) -> set[Path]:
    """The shared memory it uses."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if line.endswith(".zenoh")}


@pytest.mark.thorough
def test_a_short_run_leaves_results_and_nothing_else(temporary: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    options = ("--seconds", "0.3", "--rounds", "2", "--size", "64x48", "--readers", "1", "--output", str(folder))
    names = ["zenoh-shm", "zenoh-net", "mqtt"]
    ended = subprocess.run(
        command(*options, "--variants", ",".join(names)),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(folder / "frames.json")
    assert [cell.variant for cell in results.cells] == names
    assert all(cell.params == {"size": "64x48", "readers": 1} for cell in results.cells)
    assert all([len(samples) > 3 for samples in cell.rounds] == [True, True] for cell in results.cells)
    assert all(min(cell.samples) > 0 and cell.lost is not None and cell.lost >= 0 for cell in results.cells)
    assert len(results.assessment) == 3  # two comparisons, and a note about too few rounds
    assert all(line in ended.stdout for line in results.assessment)
    assert results.command[:3] == ["pebble", "bench", "frames"]
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("variant", ["zenoh-shm", "zenoh-copy"])
def test_frames_in_shared_memory_arrive_whole_at_every_reader(variant: str) -> None:
    round_ = frames.run_case(Case(variant, Size(320, 240), 2), 0.5)
    assert len(round_.latencies_us) > 10
    assert round_.torn == 0
    assert round_.fallbacks < len(round_.latencies_us) / 4  # a reader without CPU time holds buffers
    assert round_.memory_reader_mb > 0
    assert children(os.getpid()) == []


def test_the_bare_copy_counts_only_the_cpu_of_the_copier() -> None:
    round_ = frames.run_case(Case("memcpy", Size(320, 240), 1), 0.5)
    assert round_.latencies_us
    assert round_.cpu_writer == 0.0


def test_ctrl_c_leaves_nothing(temporary: Path) -> None:
    bench = subprocess.Popen(
        command("--output", str(temporary.parent), "--seconds", "30", "--size", "160x120", "--variants", "zenoh-copy"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 2, 20)
        started = children(bench.pid)
        assert until(lambda: all(map(segments, started)), 20)
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


def test_workers_end_with_a_killed_bench(temporary: Path) -> None:
    bench = subprocess.Popen(
        command("--output", str(temporary.parent), "--seconds", "30", "--size", "160x120", "--variants", "zenoh-net"),
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
    monkeypatch.setattr(frames_variants, "_SYSTEM_PYTHON", "/nowhere/python3")
    frames_variants._gstreamer.cache_clear()
    printed = io.StringIO()
    try:
        assert frames._installed(["zenoh-shm", "gstreamer-shm"], Console(file=printed, width=80)) == ["zenoh-shm"]
    finally:
        frames_variants._gstreamer.cache_clear()
    assert "gstreamer-shm is left out" in printed.getvalue()
    assert frames_variants.INSTALL_GSTREAMER in printed.getvalue()


@pytest.mark.parametrize(
    "plan",
    [
        FramesPlan(variants=["zenoh"]),
        FramesPlan(seconds=0.0),
        FramesPlan(seconds=float("nan")),
        FramesPlan(rounds=1),
        FramesPlan(readers=[0]),
        FramesPlan(sizes=["big"]),
        FramesPlan(sizes=["1x1"]),
        FramesPlan(sizes=["30x30"]),
        FramesPlan(variants=[]),
        FramesPlan(variants=["mqtt", "mqtt"]),
        FramesPlan(output=Path("/dev/null/x")),
    ],
)
def test_invalid_options_are_refused_before_anything_starts(plan: FramesPlan) -> None:
    with pytest.raises(PebbleError):
        frames.run(plan, Console(file=io.StringIO()))


def test_sizes_are_written_with_either_sign() -> None:
    assert parse_size("640×480") == parse_size("640x480") == Size(640, 480)


def test_the_command_line_of_results_repeats_them(tmp_path: Path) -> None:
    plan = frames.plan(quick=True, variants=["mqtt"], output=tmp_path)
    assert " ".join(plan.command()) == (
        "pebble bench frames --seconds 0.5 --rounds 2 --size 640x480 --readers 1 --variants mqtt --quick"
    )


def test_what_the_systems_python_runs_as_plain_files_imports_nothing_of_pebble() -> None:
    folder = ROOT / "pebble" / "bench"
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import frames_gstreamer; print('pebble' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True).stdout
        == "False\n"
    )
