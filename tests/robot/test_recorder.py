"""A robot that records itself, on both transports."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from pebble.extensions.recordings import library
from tests.robot.rig import Rig
from tests.support import further, until

pytestmark = pytest.mark.alone

BASE = "pebble/robots/rover"


def counted(folder: Path) -> Counter[tuple[str, str]]:
    """Messages by topic and connection."""
    if not list(folder.rglob("*.mcap*")):
        return Counter()
    found = library.merged(library.files([folder]))
    return Counter((message.channel.topic, message.channel.metadata.get("source", "")) for message in found)


@pytest.mark.parametrize("kind", [further("mqtt"), "zenoh"])
def test_what_a_robot_publishes_is_recorded_on_it(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    section = {"enabled": True, "folder": str(folder), "free_bytes": 0, "remote": True}
    with Rig(kind, recorder=section) as rig:
        assert until(lambda: counted(folder)[f"{BASE}/outgoing/online", "remote"] > 2)  # it reads what is written
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.1})
        assert until(lambda: rig.mcu.turning())
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})
        assert until(lambda: not rig.mcu.turning())
        for topic, source, least in (
            ("incoming/drive-values", "remote", 2),
            ("incoming/drive-values", "", 2),
            ("outgoing/status", "", 1),
        ):
            assert until(lambda: counted(folder)[f"{BASE}/{topic}", source] >= least), (topic, source)  # noqa: B023
    assert not list(folder.rglob("*.active"))
