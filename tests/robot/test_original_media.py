"""Stand-ins for the original's scripts on a whole robot: pictures from GStreamer, hall samples in shared memory."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.robot.closed_loop.following import ORIGINAL_WITHIN_M, TARGET_M, Start
from tests.robot.world_rig import FOLLOW, WorldRig
from tests.support import ROOT, THOROUGH, Child, cases, gone, until

SYSTEM = "/usr/bin/python3"  # its OpenCV has GStreamer: what owners of the original run its scripts with
_NEEDED = "import cv2, paho.mqtt.client; assert 'GStreamer:                   YES' in cv2.getBuildInformation()"
pytestmark = [
    pytest.mark.alone,  # deadlines are checked
    pytest.mark.thorough,
    pytest.mark.skipif(
        THOROUGH
        and not (
            shutil.which("gst-launch-1.0")
            and Path(SYSTEM).exists()
            and subprocess.run([SYSTEM, "-c", _NEEDED], stderr=subprocess.DEVNULL).returncode == 0
        ),
        reason="GStreamer is not installed, or the system's Python has no OpenCV with GStreamer, or no paho",
    ),
]
PERSON = {"x": 0, "z": -0.4}
MIA = {"id": "aaaaaaaa", "by": "mia", "for_ms": 3000}
PERSONS_WHEELS = (-0.4, -0.4)
LEAST_RATE = cases(5, 10)  # of 15 pictures a second: others may use this machine
MOST_S = 40.0  # to find the tag and drive to it


class OriginalRig(WorldRig):
    """A robot in a world with the original's local media, and stand-ins for its scripts in the system's Python."""

    sockets: Child | None = None

    def __init__(self, kind: str) -> None:
        self.shm = f"pebble-test-{os.getpid()}-{kind}"
        needs = [{"file": "original-locations"}, {"file": "original-odometry"}]
        name = [{"key": "memory", "arg": "--shm-name", "default": self.shm}]
        scripts: dict[str, dict[str, Any]] = {
            "original-follow": {"dependencies": needs},
            "original-odometry": {"args": name},
        }
        super().__init__(
            kind, mirror=kind == "zenoh", pictures_socket=True, scripts=scripts,
            serial_mcu_bridge={"odometry_shm": {"name": self.shm}}, top={"security": {"strangers": "free"}},
        )  # fmt: skip
        self.offer()

    def offer(self) -> None:
        """Start what offers the pictures, as its unit does."""
        program = ROOT / "examples" / "gstreamer_sockets.py"
        self.sockets = Child([sys.executable, str(program), str(self.config)], cwd=ROOT)

    def close(self) -> None:
        if self.sockets is not None:
            self.sockets.terminate()
            self.sockets.wait(10)
        super().close()
        (Path("/dev/shm") / self.shm).unlink(missing_ok=True)

    def arrives(self) -> bool:
        """Whether it stands at its distance from the tag for a second, before long."""
        end = time.monotonic() + MOST_S
        while time.monotonic() < end:
            since = time.monotonic()
            if not until(lambda: not self.near(), 1.0, step=0.05) and time.monotonic() - since >= 1.0:
                return True
            time.sleep(0.05)
        return False

    def near(self) -> bool:
        return abs(self.world.tag_from(self.name)[0] - TARGET_M) <= ORIGINAL_WITHIN_M


@pytest.fixture(scope="module", params=["zenoh", "mqtt"])
def rig(request: pytest.FixtureRequest) -> Iterator[OriginalRig]:
    """One robot at a time: several would slow one another down."""
    robot = OriginalRig(request.param)
    with robot:
        yield robot


def odometry(rig: OriginalRig) -> dict[str, Any]:
    seen = rig.operator.last("outgoing/wheel-odometry")
    return {} if seen is None else dict(seen.json["value"])


def rate(rig: OriginalRig, since: float) -> float:
    """How many pictures came through the socket in a second."""
    seen = [message.json for message in rig.operator.on("outgoing/stand-in-pictures", since)]
    return float(seen[-1]["count"] - seen[0]["count"]) / (seen[-1]["at"] - seen[0]["at"])


def test_all_at_once_follow_a_tag_obey_a_person_and_end(rig: OriginalRig) -> None:
    rig.world.place(rig.name, *Start(distance=1.1, beside=15.0, off=20.0).pose)
    pid = rig.driving("original-follow", FOLLOW)
    assert rig.arrives(), rig.log.read_text()[-3000:]

    since, before = time.monotonic(), odometry(rig)
    time.sleep(cases(4, 60))
    assert rate(rig, since) >= LEAST_RATE
    after = odometry(rig)
    assert after["gaps"] == 0
    assert (after["samples"] - before["samples"]) / (time.monotonic() - since) > 30, "50 are sent"

    rig.operator.send("incoming/control", MIA)
    assert until(lambda: rig.operator.last("outgoing/control/serial").json.get("id") == MIA["id"], 5)
    key = rig.operator.last("outgoing/control/serial").json["key"]
    began = time.monotonic()
    for _ in range(20):
        rig.operator.send("incoming/drive-values", {**PERSON, "key": key})
        time.sleep(0.05)
    assert until(lambda: rig.script()["overridden"])
    released = time.monotonic()
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0, "key": key})
    rig.operator.send("incoming/control", {**MIA, "want": "release"})
    assert until(lambda: rig.mcu.moving(released + 0.5), 10), "the script goes on"
    wheels = [one for at, one in rig.mcu.drives(began) if at < released]
    first = wheels.index(PERSONS_WHEELS)
    assert set(wheels[first:]) - {(0.0, 0.0)} == {PERSONS_WHEELS}, "only zeros of the script's count in between"
    assert rig.arrives()

    rig.end()
    assert until(lambda: gone(pid), 3)
    assert until(lambda: not rig.mcu.turning(), 2)
    assert until(lambda: not rig.script().get("running"))


def test_one_follows_a_tag_with_the_pictures_alone(rig: OriginalRig) -> None:
    rig.world.place(rig.name, *Start(distance=1.0, beside=-10.0, off=-15.0).pose)
    pid = rig.driving("original-video-follow", FOLLOW)
    began = time.monotonic()
    assert rig.arrives(), rig.log.read_text()[-3000:]
    assert rate(rig, began) >= LEAST_RATE
    assert rig.sockets is not None
    rig.sockets.kill()
    killed = time.monotonic()
    rig.offer()
    assert until(lambda: rig.operator.on("outgoing/stand-in-pictures", killed + 0.5), 15), "it opens the socket again"
    rig.idle()
    assert until(lambda: gone(pid), 3)
