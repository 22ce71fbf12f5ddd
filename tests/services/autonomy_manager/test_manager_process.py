"""The manager as a process, with real scripts, on both transports."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.services.autonomy_manager.manager_rig import ManagerRig, started
from tests.support import gone, until


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ManagerRig]:
    rig = ManagerRig(request.param, tmp_path)
    yield rig
    rig.close()


def test_a_script_is_listed_started_and_stopped(rig: ManagerRig) -> None:
    folder = rig.script("walk", args=[{"key": "speed", "type": "float", "default": 0.5, "arg": "--speed", "max": 1}])
    rig.start()
    pid = rig.run("walk", speed="0.25")
    assert until(lambda: started(folder))
    assert started(folder) == [(pid, ["--config", str(rig.folder / "rover.json"), "--speed", "0.25"], None)]
    assert rig.status["config"] == {"speed": 0.25}
    rig.command({"value": {"enabled": False}})
    assert until(lambda: rig.status["running"] is False)
    assert gone(pid)
    assert rig.status["error"] is None
