"""The bytes of Debian's own ROS, and nodes of roscpp."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from pebble.services.ros1_bridge import messages
from tests.ext.ros1_bridge.conftest import DEBIAN_ONLY, Husky, World
from tests.support import until

pytestmark = DEBIAN_ONLY
RELAY = "/usr/lib/topic_tools/relay"
GENPY = """
import io, json
from actionlib_msgs.msg import GoalID, GoalStatusArray
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
from std_msgs.msg import Bool
forms = (Twist, Bool, GoalID, Odometry, DiagnosticArray, PoseStamped, GoalStatusArray, Path)
twist = Twist(); twist.linear.x, twist.angular.z = 0.5, -1.25
def packed(message):
    file = io.BytesIO(); message.serialize(file); return file.getvalue().hex()
print(json.dumps([[[form._type, form._md5sum] for form in forms], packed(twist), packed(Bool(True)), packed(GoalID())]))
"""


def test_bytes_and_digests_are_those_of_genpy() -> None:
    out = subprocess.run(["/usr/bin/python3", "-c", GENPY], capture_output=True, text=True, check=True).stdout
    forms, *packed = json.loads(out)
    assert [tuple(form) for form in forms] == [
        messages.TWIST, messages.BOOL, messages.GOAL_ID, messages.ODOMETRY, messages.DIAGNOSTICS, messages.POSE,
        messages.GOAL_STATUS, messages.PATH,
    ]  # fmt: skip
    assert packed == [messages.twist(0.5, -1.25).hex(), messages.boolean(True).hex(), messages.CANCEL_ALL.hex()]


@pytest.mark.skipif(not Path(RELAY).exists(), reason=f"{RELAY} is missing")
def test_nodes_of_roscpp_hear_and_are_heard(tmp_path: Path) -> None:
    debian = World(tmp_path, "debian")
    debian.start_master()
    debian.start_base()
    for source, target in (("/pebble/cmd_vel", "/cmd_vel"), ("/odometry/filtered", "/pebble/odometry")):
        name = f"__name:=relay{target.replace('/', '_')}"
        process = subprocess.Popen([RELAY, source, target, name], env=debian.environment)
        debian.ends.callback(process.wait)
        debian.ends.callback(process.kill)
    names = {"cmd_vel_topic": "/pebble/cmd_vel", "odometry_topic": "/pebble/odometry"}
    husky = Husky(debian, tmp_path, ros=names).ready()
    begin = time.monotonic_ns()
    husky.drive(0.5)
    assert debian.moves(begin)
    assert until(lambda: debian.zeros(begin + 500_000_000))
    assert husky.world.newest("wheel-odometry")["value"]["y_mm"] == 500.0
    husky.end()
    debian.ends.close()
