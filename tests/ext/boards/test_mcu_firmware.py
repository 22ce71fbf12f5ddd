"""Our own firmware for the inertial sensor, on a simulated board behind a pty, and the service: on both transports."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.pty import PtyMcu
from tests.kit.board import SerialRig
from tests.support import cases, until

FAST, SLOW = "sensors/imu-fast", "sensors/imu"
PLUGGED_IN_S = 2.0


@pytest.fixture(params=[pytest.param("mqtt", marks=pytest.mark.thorough), "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SerialRig]:
    rig = SerialRig(request.param, tmp_path)
    yield rig
    rig.close()


@pytest.fixture
def board(rig: SerialRig) -> Iterator[PtyMcu]:
    with PtyMcu("goob_imu", rig.folder / "imu") as board:
        yield board


def uid_of(rig: SerialRig) -> str:
    """Wait for the manifest of the board, and return its uid."""
    assert until(lambda: any(message.topic.endswith("/describe") for message in list(rig.world.received)), 5)
    described = next(message for message in rig.world.received if message.topic.endswith("/describe"))
    return described.topic.split("/")[-2]


def numbers(rig: SerialRig, since: int = 0) -> list[int]:
    """The numbers of the samples that have come; each is one more than the one before."""
    found = [body["seq"] for body in rig.world.payloads(FAST)[since:]]
    assert found == list(range(found[0], found[0] + len(found)))
    return found


@pytest.mark.alone
def test_found_within_two_seconds_and_again_when_plugged_in_again_and_every_sample_arrives(
    rig: SerialRig, board: PtyMcu
) -> None:
    board.unplug()
    running = rig.bridge("imu")
    time.sleep(0.3)
    plugged = time.monotonic()
    board.replug()
    uid = uid_of(rig)
    assert until(lambda: rig.world.on(FAST) and rig.world.on(SLOW))
    for metric in (f"mcu/{uid}/describe", f"mcu/{uid}/imu_fast", FAST):
        assert rig.world.first(metric) - plugged < PLUGGED_IN_S
    time.sleep(cases(2, 5))
    assert len(numbers(rig)) >= 96 * cases(2, 5)
    fast, slow = rig.world.payloads(FAST)[-1], rig.world.payloads(SLOW)[-1]
    assert fast["value"]["accel_mps2"]["z"] == pytest.approx(9.8, abs=0.5), "the board lies flat"
    assert slow["value"]["accel_norm_g"] == pytest.approx(1.0, abs=0.05)
    assert slow["value"]["health"]["samples_error"] == 0
    board.unplug()
    assert rig.cleared(f"mcu/{uid}/describe", timeout=2)
    count, plugged = len(rig.world.on(FAST)), time.monotonic()
    board.replug()
    assert until(lambda: len(rig.world.on(FAST)) > count, 3)
    assert rig.world.at[-1] - plugged < PLUGGED_IN_S
    rig.described(uid)
    assert running.alive
    assert until(lambda: len(numbers(rig, count)) > 50)
