"""Short runs of comparisons with whole robots, which leave nothing behind."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from pebble.extensions.lab.bench import bridge, cost, startup
from pebble.extensions.lab.bench.impair import trials
from pebble.extensions.lab.bench.impair.network import why_no_namespaces
from pebble.extensions.lab.bench.show import Shown, finish
from pebble.extensions.lab.rig.processes import children

pytestmark = [pytest.mark.alone, pytest.mark.thorough]  # whole robots

SLOW = {"quiet_s": 0.1, "alone_s": 0.3, "window_s": 1.0, "grace_s": 0.2, "off_s": 0.6}
#: By name: the run, and the least number of figures that it has.
RUNS: dict[str, tuple[Callable[[Console], Shown], int]] = {
    "startup": (lambda console: startup.run(startup.Settings(rounds=1, joins=2), console), 10),
    "cost": (lambda console: cost.run(cost.Settings(seconds=0.4, rounds=1), console), 100),
    "bridge": (lambda console: bridge.run(bridge.Settings(seconds=1.0, rounds=1), console), 18),
}
for subject in ("zenoh h264 opus", "mqtt original"):
    settings = trials.Settings(trials=("512k",), subjects=(subject,), **SLOW)  # type: ignore[arg-type]
    RUNS[f"impair {subject}"] = (lambda console, settings=settings: trials.run(settings, console), 7)  # type: ignore[misc]


@pytest.mark.parametrize("name", RUNS)
def test_it_measures_whole_robots(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "_STARTUP_S", 0.0)
    run, least = RUNS[name]
    if name.startswith("impair") and (obstacle := why_no_namespaces()):
        pytest.skip(f"no namespaces: {obstacle}")
    shown = run(Console(file=io.StringIO()))
    assert finish(shown, tmp_path, Console(file=io.StringIO())) == 0
    measured = [cell for cell in shown.results.cells if cell.samples]
    assert len(measured) >= least, [cell.measure for cell in measured]
    assert children(os.getpid()) == []
