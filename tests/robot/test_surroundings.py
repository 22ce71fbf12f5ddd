"""Robots that start and stop in odd surroundings: without an environment, at any moment, several at once."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
from typing import Any

import pytest

from tests.robot.rig import STOP, Rig, descendants
from tests.support import ROOT, further, gone, some, until

pytestmark = pytest.mark.alone

SURROUNDINGS: dict[str, dict[str, Any]] = {
    "no environment, and folders that do not exist": {
        "env": {"PYTHONPATH": str(ROOT)} | dict.fromkeys(("HOME", "TMPDIR", "XDG_STATE_HOME"), "/nowhere/at/all")
    },
    "no standard streams": {"preexec_fn": lambda: [os.close(number) for number in range(3)]},
}


def drives_and_stops(rig: Rig, since: int = 0) -> None:
    """``since``: from where on the log has no traceback."""
    rig.operator.send("incoming/drive-values", {"x": 0.5, "z": 0})
    assert until(rig.mcu.moving), rig.log.read_text()[-4000:]
    children = descendants(rig.launcher_pid)
    assert rig.stop() == 0
    assert rig.mcu.drives()[-1][1] == STOP
    assert until(lambda: all(map(gone, children)))
    assert "Traceback" not in rig.log.read_text()[since:]


@pytest.mark.parametrize("surroundings", SURROUNDINGS.values(), ids=SURROUNDINGS)
def test_a_robot_runs(surroundings: dict[str, Any]) -> None:
    with Rig("zenoh", start=False) as rig:
        began = rig.start(ready=False, **surroundings)
        rig.wait_until_up(began)
        drives_and_stops(rig)


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
@pytest.mark.parametrize("files", [20, further(40)])
def test_too_few_descriptors_are_an_error_or_enough(kind: str, files: int) -> None:
    with Rig(kind, start=False) as rig:
        rig.start(ready=False, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (files, files)))
        ended = until(lambda: gone(rig.launcher_pid), 3.0)
        if not ended:  # it goes on, and can be stopped
            assert rig.stop() == 0
        else:
            assert rig.stop() != 0


def test_a_stop_at_any_moment_of_the_start_leaves_nothing() -> None:
    with Rig("zenoh", start=False) as rig:
        for index in some(range(20), 4):
            rig.start(ready=False)
            time.sleep(0.04 * index)
            children = descendants(rig.launcher_pid)
            rig.stop((signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[index % 3])
            assert until(lambda pids=children: all(map(gone, pids)))  # type: ignore[misc]
        assert not until(lambda: remains(rig), 0.5)
        before = len(rig.log.read_text())  # the interpreter prints a signal that comes before any of our code
        rig.start()
        drives_and_stops(rig, since=before)


def remains(rig: Rig) -> list[str]:
    """Programs of this robot that run."""
    found = subprocess.run(["pgrep", "-f", str(rig.config)], capture_output=True, text=True, check=False)
    return found.stdout.split()


@pytest.mark.parametrize(
    ("kind", "options", "signals"),
    [("mqtt", {"shutdown_timeout_seconds": 0}, 1), ("zenoh", {}, 2)],
)
def test_a_hurried_stop_stops_the_wheels(kind: str, options: dict[str, Any], signals: int) -> None:
    with Rig(kind, launcher=options) as rig:
        rig.operator.send("incoming/drive-values", {"x": 0.5, "z": 0})
        assert until(rig.mcu.moving)
        children = descendants(rig.launcher_pid)
        rig.stop(*[signal.SIGTERM] * signals)
        assert until(lambda: all(map(gone, children)))
        assert until(lambda: not rig.mcu.turning())
