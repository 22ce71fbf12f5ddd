"""A robot whose pictures go their own way: operators switch that program as they switch any camera."""

from __future__ import annotations

import sys

import pytest

from tests.robot.rig import Rig
from tests.support import until

pytestmark = pytest.mark.alone

URL = "http://pitcam.local:8889/cam"


def test_the_stream_runs_while_it_is_wanted_and_its_address_is_in_the_status() -> None:
    stream = {"enabled": True, "command": [sys.executable, "-c", "import time; time.sleep(600)"], "webrtc_url": URL}
    with Rig("zenoh", video_stream=stream) as rig:
        assert rig.operator.wait_for("outgoing/status").json["value"]["webrtc_url"] == URL
        rig.operator.send("incoming/flags/mqtt-video", {"value": True}, retain=True)
        rig.operator.send("incoming/front-camera", {"enabled": True})
        assert until(lambda: "video_stream" in rig.processes(), 10)
        rig.operator.send("incoming/front-camera", {"enabled": False})
        assert until(lambda: "video_stream" not in rig.processes(), 10)
