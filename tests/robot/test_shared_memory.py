"""What a robot leaves in /dev/shm when it has stopped: nothing."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from pebble.transports.segments import YOUNG_S
from tests.robot.rig import DEVICES, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone

SEGMENT = re.compile(r"/dev/shm/\d+\.zenoh")


def segments_of(rig: Rig) -> set[str]:
    mapped = [Path(f"/proc/{pid}/maps").read_text() for pid in rig.processes().values()]
    return {path for one in mapped for path in SEGMENT.findall(one)}


@pytest.mark.parametrize("kind", [further("mqtt"), "zenoh"])
def test_a_robot_that_has_stopped_leaves_no_shared_memory(kind: str) -> None:
    with Rig(kind, av_daemon=DEVICES) as rig:
        rig.operator.send("incoming/front-camera", {"enabled": True})
        rig.operator.send("incoming/flags/mqtt-video", {"value": True}, retain=True)
        assert until(lambda: "camera_publisher" in rig.processes() and len(segments_of(rig)) >= 2, 20), (
            f"{rig.processes()}, {segments_of(rig)}:\n{rig.log.read_text()[-4000:]}"
        )
        time.sleep(2 * YOUNG_S)  # younger ones may still be in the making and are left alone
        used = segments_of(rig)
        assert rig.stop() == 0
        assert [path for path in used if Path(path).exists()] == []
