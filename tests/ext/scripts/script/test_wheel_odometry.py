"""What wheel-odometry logs where no hall sensors are published."""

from __future__ import annotations

import itertools
import logging
import runpy
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

from pebble.config import parse
from pebble.extensions.scripts.script import Stopped
from tests.support import ROOT


def test_without_samples_it_names_the_key_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    script = runpy.run_path(str(ROOT / "pebble/extensions/scripts/shipped/wheel-odometry/run.py"))
    robot = Mock(config=parse({"robot": {"id": "goob"}}, folder=tmp_path, env={}), log=logging.getLogger("odometry"))
    robot.sleep.side_effect = [None] * 9 + [Stopped(0)]
    monkeypatch.setattr(time, "monotonic", itertools.count().__next__)
    with pytest.raises(Stopped):
        script["main"](robot, script["OdometrySettings"]())
    assert caplog.text.count("services.serial_mcu_bridge.telemetry.publish_touch_sensors") == 1
