"""A quick run of each comparison: real processes, real brokers, and nothing of them afterwards."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from pebble.extensions.lab.bench.impair.network import why_no_namespaces
from pebble.extensions.lab.bench.report import SECTIONS, Section
from pebble.extensions.lab.bench.results import load
from pebble.extensions.lab.rig.processes import children
from tests.support import ROOT, WAIT_S, gone, until


def command(name: str, *options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", name, "--quick", *options]


@pytest.fixture
def temporary() -> Iterator[Path]:
    """The folder for temporary files of the bench; short, because of Unix sockets: it would take another one."""
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        yield Path(folder)


@pytest.fixture
def _possible(section: Section) -> None:
    """Skips what this machine cannot measure; asked for only when a test needs it."""
    if section.needs_root and (obstacle := why_no_namespaces()):
        pytest.skip(f"no namespaces: {obstacle}")
    if section.name == "traffic" and find_spec("duckdb") is None:
        pytest.skip("needs DuckDB")


@pytest.mark.alone
@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.usefixtures("_possible")
@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_a_quick_run_leaves_results_and_nothing_else(section: Section, temporary: Path, tmp_path: Path) -> None:
    ended = subprocess.run(
        command(section.name, "--output", str(tmp_path)),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, check=False,
        timeout=300,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(tmp_path / f"{section.name}.json")
    assert results.complete
    assert results.quick
    assert results.cells
    assert all(sample >= 0 for cell in results.cells for sample in cell.samples)
    assert list(temporary.iterdir()) == []


def segments(pid: int) -> set[Path]:
    """The shared memory it uses."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if line.endswith(".zenoh")}


def test_ctrl_c_leaves_nothing(temporary: Path) -> None:
    bench = subprocess.Popen(
        command("frames", "--output", str(temporary / "results"), "--seconds", "30", "--variants", "zenoh-shm"),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert until(lambda: len(children(bench.pid)) == 2)
        started = children(bench.pid)
        assert until(lambda: all(map(segments, started)))
        shared = set().union(*map(segments, started))
        time.sleep(1)  # files younger than a second are not swept
        bench.send_signal(signal.SIGINT)
        assert bench.wait(WAIT_S) == 130
    finally:
        bench.kill()
        bench.wait()
    assert until(lambda: all(map(gone, started)))
    assert not any(segment.exists() for segment in shared)
    assert list(temporary.iterdir()) == [temporary / "results"]
