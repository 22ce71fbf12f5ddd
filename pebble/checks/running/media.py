"""Checks that pictures and sound reach operators: they are requested as an operator does, and given back."""

import time

from pebble.checks.check import CheckResult, failed, ok, skipped
from pebble.checks.running.robot import RobotUnderTest
from pebble.client.media_receiver import MediaReceiver
from pebble.client.media_request.offer import Medium
from pebble.errors import PebbleError

_LOG = "pebble doctor CONFIG; journalctl -u pebble -n 50"
_PROGRAMS: dict[Medium, str] = {"video": "camera_publisher", "audio": "audio_publisher"}


def received(robot: RobotUnderTest, medium: Medium, device: str) -> CheckResult:
    if _PROGRAMS[medium] not in robot.config.media_programs():
        return skipped(f"it has no {device}")
    assert robot.operators is not None  # noqa: S101 - the table says so
    receiver = MediaReceiver(robot.operators.transport, robot.config.base)
    try:
        receiver.wait_for_capabilities(robot.patience_s)
        began = time.monotonic()
        receiver.request(medium)
        if not robot.wait(lambda: _arrived(receiver, medium), robot.patience_s):
            return failed(f"none came from the {device} within {robot.patience_s:g} s", _LOG)
        took = time.monotonic() - began
    except PebbleError as error:
        return failed(str(error), _LOG)
    finally:
        receiver.close()
    shown = "" if receiver.newest is None else "{1}×{0}, ".format(*receiver.newest.picture.shape[:2])
    return ok(f"{shown}{receiver.encoding[medium]}, after {took:.1f} s")


def _arrived(receiver: MediaReceiver, medium: Medium) -> bool:
    receiver.poll()
    return receiver.newest is not None if medium == "video" else receiver.sounds.count > 0
