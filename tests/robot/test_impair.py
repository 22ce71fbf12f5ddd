"""One short trial of whole robots, which leaves nothing behind."""

from __future__ import annotations

import io
import os
from pathlib import Path

import pytest
from rich.console import Console

from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.impair.network import why_no_namespaces
from pebble.extensions.lab.bench.impair.trials import Settings, run
from pebble.extensions.lab.bench.show import finish
from pebble.extensions.lab.rig.processes import children

pytestmark = pytest.mark.alone  # whole robots

SHORT = {"quiet_s": 0.1, "alone_s": 0.3, "window_s": 1.0, "grace_s": 0.2, "off_s": 0.6, "clip_s": 20.0}


@pytest.fixture(autouse=True)
def permitted() -> None:
    """Skips without permission; checked by creating them."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.mark.thorough
@pytest.mark.parametrize("subject", ["zenoh h264 opus", "mqtt original"])
def test_a_robot_is_driven_and_streams_media_over_a_slow_network(subject: str, tmp_path: Path) -> None:
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
    assert finish(shown, tmp_path, Console(file=io.StringIO())) == 0
    assert children(os.getpid()) == []
