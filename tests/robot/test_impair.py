"""One short trial of whole robots, and an interrupted one: nothing is left behind."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench.impair import metrics
from pebble.bench.impair.network import why_no_namespaces
from pebble.bench.impair.trials import Settings, run
from pebble.rig.processes import children
from tests.robot.rig import Rig, descendants
from tests.support import ROOT, until

pytestmark = pytest.mark.alone  # whole robots

SHORT = {"quiet_s": 0.1, "alone_s": 0.3, "window_s": 1.0, "grace_s": 0.2, "off_s": 0.6, "clip_s": 20.0}


@pytest.fixture(autouse=True)
def permitted() -> None:
    """Skips without permission; checked by creating them."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.mark.thorough
@pytest.mark.parametrize("subject", ["zenoh h264 opus", "mqtt original"])
def test_a_robot_is_driven_and_streams_media_over_a_slow_network(subject: str) -> None:
    shown = run(Settings(trials=("512k",), subjects=(subject,), **SHORT), Console(file=io.StringIO()))
    cells = {cell.measure: cell for cell in shown.results.cells}
    assert {cell.variant for cell in cells.values()} == {subject}
    assert shown.results.complete
    assert cells[metrics.SOUND].samples
    assert cells[metrics.PICTURES].samples
    assert cells[metrics.PICTURES].middle("kbit_up") > 10
    assert min(cells[metrics.DRIVE].samples) > 0
    assert len(cells[metrics.HEARTBEAT_GAP].samples) > 1
    for measure in (metrics.AFTER_VIDEO, metrics.AFTER_AUDIO):
        assert cells[measure].total("bytes_up") > 0
        assert cells[measure].total("heartbeats") > 0
    clip = cells[metrics.CLIP]
    assert clip.lost == 0
    assert 0 < clip.samples[0] < 20_000
    assert len(shown.tables) == 5
    assert children(os.getpid()) == []


@pytest.mark.thorough
def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="i-", dir="/tmp") as short:  # as below it are Unix sockets
        _end_by_ctrl_c(tmp_path, Path(short))


def _end_by_ctrl_c(tmp_path: Path, temporary: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "pebble.cli",
        "bench",
        "impair",
        "--subjects",
        "mqtt original",
        "--output",
        str(tmp_path),
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, "TMPDIR": str(temporary)}, stdout=subprocess.DEVNULL
    )
    try:
        assert until(lambda: len(list(temporary.glob("pbl-*/the operator*.log"))) == 1, 60), "the robot does not start"
        started = descendants(process.pid)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    finally:
        process.kill()
        process.wait()
    assert len(started) > 4
    assert until(lambda: not any(map(Rig.alive, started)))
    assert not list(temporary.glob("pbl-*"))
