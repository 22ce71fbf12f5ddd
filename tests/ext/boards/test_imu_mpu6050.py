"""The service for imu_mpu6050_v1 publishes what its lines report."""

from __future__ import annotations

import logging
import time

import pytest

from tests.ext.boards.mcu_wire import M
from tests.kit.board import ScriptedMcu, SerialRig
from tests.services.serial_mcu_bridge.test_text_protocols import FAST, SLOW
from tests.support import until


def plugged(memory_rig: SerialRig) -> ScriptedMcu:
    """A board. It speaks a text protocol, so its manifest ``M`` is never asked for."""
    return memory_rig.mcu(M("unused"))


def test_samples_and_summaries_are_published(memory_rig: SerialRig) -> None:
    mcu = plugged(memory_rig)
    memory_rig.bridge(protocol="imu_mpu6050_v1")

    def received() -> object:
        mcu.send(SLOW + b"\n", FAST + b"\r\n", SLOW + b"\n")
        time.sleep(0.05)
        return memory_rig.world.payloads("sensors/imu")

    assert until(received)
    fast, slow = memory_rig.world.payloads("sensors/imu-fast")[0], memory_rig.world.payloads("sensors/imu")[0]
    assert (fast["seq"], fast["mcu_ms"], fast["value"]["orientation_deg"]) == (17, 1234, {"roll": 1.5, "pitch": -3.25})
    assert fast["value"]["gyro_dps"] == {"x": 1.25, "y": -2.0, "z": 0.0001}
    assert slow["value"]["accel_mps2"] == fast["value"]["accel_mps2"] == {"x": 0.123, "y": -0.5, "z": 9.807}
    assert slow["value"]["health"] == {
        "device": str(memory_rig.folder / "one"), "protocol": "imu_mpu6050_v1", "instance": "one",
        "samples_ok": 1000, "samples_error": 2, "calibration_samples": 200,
    }  # fmt: skip
    topics = {
        message.topic.removeprefix(f"{memory_rig.base}/outgoing/"): int(message.qos)
        for message in memory_rig.world.received
    }
    assert topics == {"sensors/imu-fast": 0, "sensors/imu": 1}


def test_malformed_lines_are_logged_and_nothing_is_ever_sent(
    memory_rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    mcu = plugged(memory_rig)
    running = memory_rig.bridge(protocol="imu_mpu6050_v1")

    def received() -> object:
        mcu.pour(b"I n=1\n" + b"x" * 5000 + b"\n" + FAST + b"\n")  # a pty holds 4 kB until the bridge reads
        time.sleep(0.05)
        logged = [(record.getMessage(), record.levelno) for record in caplog.records]
        return memory_rig.world.payloads("sensors/imu-fast") and ("MCU: I n=1", logging.WARNING) in logged

    assert until(received)  # what is sent while the port is being opened may be cut short
    assert running.service.counters["lines_discarded"] >= 1
    running.stop()
    assert (mcu.received, mcu.rest) == ([], b"")
