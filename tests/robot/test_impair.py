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

from pebble.bench import engine
from pebble.bench.impair import metrics
from pebble.bench.impair.network import why_no_namespaces
from pebble.bench.impair.trials import IMPAIR
from pebble.bench.results import load
from pebble.rig.processes import children
from tests.bench.found import found
from tests.robot.rig import Rig, descendants
from tests.support import ROOT, until

pytestmark = pytest.mark.alone  # whole robots

MEASURES = (metrics.SOUND, metrics.PICTURES, metrics.DRIVE, metrics.HEARTBEAT_GAP)
SHORT = {"quiet_s": 0.1, "alone_s": 0.3, "window_s": 1.0, "grace_s": 0.2, "off_s": 0.6, "clip_s": 20.0}


@pytest.fixture(autouse=True)
def permitted() -> None:
    """Skips without permission; checked by creating them."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.mark.thorough
@pytest.mark.parametrize("subject", ["zenoh h264 opus", "mqtt original"])
def test_a_robot_is_driven_and_streams_media_over_a_slow_network(
    subject: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)  # no plots
    printed = io.StringIO()
    given = {"trials": ["512k"], "variants": [subject], **SHORT}
    console = Console(file=printed, width=120)
    assert engine.run(IMPAIR.run_of(quick=True, output=tmp_path, console=console, **given)) == 0
    results = load(tmp_path / "impair.json")
    sound, video, drive, heartbeat, after_video, after_audio, clip = (
        found(results, subject, measure, trial="512k")
        for measure in (*MEASURES, metrics.AFTER_VIDEO, metrics.AFTER_AUDIO, metrics.CLIP)
    )
    assert sound is not None
    assert sound.samples
    assert video is not None
    assert video.samples
    assert float(str(video.figures["kbit_up"])) > 10
    assert drive is not None
    assert drive.samples
    assert min(drive.samples) > 0
    assert heartbeat is not None
    assert len(heartbeat.samples) > 1
    for after in (after_video, after_audio):
        assert after is not None
        assert int(str(after.figures["bytes_up"])) > 0
        assert int(str(after.figures["heartbeats"])) > 0
    assert clip is not None
    assert clip.lost == 0
    assert 0 < clip.samples[0] < 20_000
    assert "after media were switched off" in printed.getvalue()
    assert "512k@" in str(results.options["marks"])
    assert children(os.getpid()) == []


@pytest.mark.thorough
def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="i-", dir="/tmp") as short:  # as below it are Unix sockets
        _end_by_ctrl_c(tmp_path, Path(short))


def _end_by_ctrl_c(tmp_path: Path, temporary: Path) -> None:
    command = [sys.executable, "-m", "pebble.cli", "impair", "--subjects", "mqtt original", "--output", str(tmp_path)]
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
