"""A script of the original's shape, which knows nothing of signatures, on a whole robot."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.robot.rig import STOP, Rig
from tests.support import ROOT, gone, until

pytestmark = pytest.mark.alone  # deadlines are checked

BACK = {"x": 0, "z": -0.4}  # the script turns on the spot: its wheels never move in the same direction


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    folder = tmp_path / "scripts" / "follow"
    folder.mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "fakes" / "original_follow.py", folder / "run.py")
    manager = {"enabled": True, "autonomy_root": str(folder.parent), "stop_timeout_seconds": 2}
    with Rig(request.param, mirror=request.param == "zenoh", autonomy_manager=manager) as rig:
        yield rig


def status(rig: Rig) -> dict[str, Any]:
    seen = rig.operator.last("outgoing/autonomy-status")
    return {} if seen is None else dict(seen.json)


def started(rig: Rig) -> int:
    """Start the script, and return its pid once it drives."""
    since = time.monotonic()
    assert until(lambda: "follow" in str(rig.operator.last("outgoing/autonomy-files")))
    rig.operator.send("incoming/autonomy-command", {"action": "start", "file": "follow"})
    assert until(lambda: status(rig).get("running")), status(rig)
    assert until(lambda: rig.mcu.moving(since)), rig.log.read_text()
    return int(status(rig)["pid"])


def by_person(wheels: tuple[float, float]) -> bool:
    return wheels[0] < 0 and wheels[1] < 0


def control(rig: Rig, **wanted: Any) -> dict[str, Any]:
    """Ask for control, and return the state of the motor owner."""
    rig.operator.send("incoming/control", {"id": "aaaaaaaa", "by": "mia", "for_ms": 3000, **wanted})
    seen = rig.operator.last("outgoing/control/serial")
    return {} if seen is None else dict(seen.json)


def test_a_person_with_control_goes_first_and_every_end_of_the_script_stops_the_wheels(rig: Rig) -> None:
    pid = started(rig)

    assert until(lambda: control(rig).get("id") == "aaaaaaaa", step=0.1)
    key = control(rig)["key"]
    began = time.monotonic()
    for _ in range(5):
        rig.operator.send("incoming/drive-values", {**BACK, "key": key})
        time.sleep(0.05)
    released = time.monotonic()
    control(rig, want="release")
    assert until(lambda: rig.mcu.moving(released + 0.5), 5), "the script goes on"
    lines = rig.mcu.drives(began)
    first = next(index for index, (_, wheels) in enumerate(lines) if by_person(wheels))
    assert lines[first][0] - began < 0.25, "a few milliseconds on an idle machine"
    assert [wheels for at, wheels in lines[first:] if at < released and not by_person(wheels)] == []

    stopped = time.monotonic()
    rig.operator.send("incoming/autonomy-command", {"action": "stop"})
    assert until(lambda: not rig.mcu.moving(stopped) and rig.mcu.drives(stopped), 1)
    assert until(lambda: gone(pid), 2)
    assert until(lambda: status(rig)["running"] is False)

    pid = started(rig)
    killed = rig.kill("autonomy_manager")
    assert until(lambda: gone(pid), 1)
    assert until(lambda: rig.mcu.drives(killed) and not rig.mcu.moving(killed), 2)
    ended = next(at for at, wheels in rig.mcu.drives(killed) if wheels == STOP)
    assert ended - killed < 0.9
