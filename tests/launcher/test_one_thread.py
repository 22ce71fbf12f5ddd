"""The launcher forks its programs, so it must never have a second thread or a session (docs/decisions/0006)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.robot.rig import Rig


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_the_launcher_has_one_thread_and_only_its_own_sockets(kind: str) -> None:
    with Rig(kind) as rig:
        launcher = Path(f"/proc/{rig.launcher_pid}")
        assert len(list((launcher / "task").iterdir())) == 1
        opened = [path.readlink().name for path in (launcher / "fd").iterdir()]
        sockets = [name for name in opened if name.startswith("socket:")]
        assert len(sockets) == 3, "two for its stop signals, one to the announcer"
        assert {"announcer", "zenoh_hub"} & rig.processes().keys()
