"""The forms of the scripts that come with Pebble: the original's keys, options, defaults and limits."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from functools import cache
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any

import pytest

from pebble.extensions.scripts.perception.odometry import OdometrySettings
from tests.support import ROOT

SCRIPTS = ROOT / "pebble/extensions/scripts/shipped"
NAMES = ("apriltag-follow", "apriltag-locations", "apriltag-odom-follow", "wheel-odometry")
#: Those for sizes that the camera decides, for other topics, and for nothing.
GONE = {"width", "height", "fps", "min_wheel_pwm"}
GONE |= {"locations_topic", "overlays_topic", "tags_topic", "odom_topic", "topic"}
#: Without a path that an operator chooses, a window on the robot's screen, and a topic that the original does not use.
ORIGINALS = json.loads((ROOT / "tests" / "data" / "original-forms.json").read_text())


@cache
def described(name: str) -> dict[str, Any]:
    command = [sys.executable, str(SCRIPTS / name / "run.py"), "--describe"]
    found: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_each_has_a_sentence_and_main_settings_and_says_whether_it_drives_and_what_it_needs(name: str) -> None:
    found = described(name)
    assert found.get("drives", True) is (name not in ("apriltag-locations", "wheel-odometry"))
    assert 10 < len(found["summary"]) <= 160
    assert 1 < len(found["main"]) <= 3
    needs = {need["file"]: need["config"] for need in found["dependencies"]}
    of_odometry = {"apriltag-locations": {}, "wheel-odometry": {"use_tune_state": False}}
    assert needs == (of_odometry if name == "apriltag-odom-follow" else {})


@pytest.mark.parametrize("name", ORIGINALS)
def test_the_originals_settings_are_all_there(name: str) -> None:
    wanted = [entry for entry in ORIGINALS[name] if entry["key"] not in GONE]
    keys = {entry["key"] for entry in wanted}
    got = [entry for entry in described(name)["configs"] if entry["key"] in keys]
    essential = ("key", "label", "type", "default", "arg", "min", "max", "required", "mode", "arg_false")
    assert [[entry.get(key) or None for key in essential] for entry in got] == [
        [entry.get(key) or None for key in essential] for entry in wanted
    ]


def tuned_in(folder: Path, **options: Any) -> OdometrySettings:
    """The settings that odometry has with a config in this folder."""
    robot = SimpleNamespace(config=SimpleNamespace(folder=folder), log=logging.getLogger("script"))
    tuned = run_path(str(SCRIPTS / "wheel-odometry" / "run.py"))["tuned"]
    return tuned(robot, OdometrySettings(**options))  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("values", "track_mm"),
    [
        ({"left_mm_per_event": 10.1, "right_mm_per_event": 10.3, "track_width_mm": 128.0}, 128.0),
        ({"left_mm_per_event": 10.1}, 130.5),
        ({"track_width_mm": -1}, 130.5),
        ([], 130.5),
    ],
)
def test_of_the_originals_tuning_only_the_width_of_the_track_counts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, values: Any, track_mm: float
) -> None:
    (tmp_path / "auto_tune_state.json").write_text(json.dumps({"version": 1, "current_values": values}))
    tuned = tuned_in(tmp_path, use_tune_state=True, right_mm_per_event=19.0)
    assert (tuned.track_width_mm, tuned.left_mm_per_event, tuned.right_mm_per_event) == (track_mm, 0, 19.0)
    assert ("counts steps twice" if track_mm == 128 else "the geometry counts") in caplog.text


MEASURED = {"left_step_mm": 19.36, "right_step_mm": 18.97, "track_mm": 134.4}


@pytest.mark.parametrize(
    ("change", "options", "wheels", "remark"),
    [
        ({}, {}, (19.36, 18.97, 134.4), ""),
        ({}, {"track_width_mm": 120.0}, (19.36, 18.97, 120.0), ""),
        ({}, {"left_mm_per_event": 19.0, "right_mm_per_event": 18.0}, (19.0, 18.0, 134.4), ""),
        ({"counts": "twice"}, {}, (0, 0, 130.5), "odometry.json: Invalid enum value 'twice'"),
    ],
)
def test_the_calibration_of_its_folder_counts_unless_options_say_otherwise(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, change: Any, options: Any, wheels: Any, remark: str
) -> None:
    usual = {"version": 1, "made": "2026-11-29", "counts": "once", "truth": "tape", "runs": 8, "residual_mm": 1.2}
    (tmp_path / "odometry.json").write_text(json.dumps({**usual, **MEASURED, **change}))
    tuned = tuned_in(tmp_path, **options)
    assert (tuned.left_mm_per_event, tuned.right_mm_per_event, tuned.track_width_mm) == wheels
    assert remark in caplog.text
    assert bool(remark) == bool(caplog.text)
