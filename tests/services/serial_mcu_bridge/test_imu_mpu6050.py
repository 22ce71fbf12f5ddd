"""imu_mpu6050_v1: the text lines of an Arduino with an inertial sensor, and the service that publishes them."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine
from pebble.services.serial_mcu_bridge.text.imu_mpu6050 import Motion, Summary, parse
from tests.kit.board import BASE, Rig, ScriptedMcu
from tests.services.serial_mcu_bridge.mcu_wire import M
from tests.support import until

FAST = b"I n=17 ms=1234 ax=0.123 ay=-0.5 az=9.807 gx=1.25 gy=-2 gz=0.0001 t=25.5 r=1.5 p=-3.25"
SLOW = b"S n=18 ms=1300 r=1.5 p=-3.25 t=25.5 an=1.001 gbx=0.1 gby=-0.2 gbz=0.3 ok=1000 err=2 cal=200"
MOTION = {
    "ax": 0.123, "ay": -0.5, "az": 9.807, "gx": 1.25, "gy": -2.0, "gz": 0.0001,
    "temp_c": 25.5, "roll_deg": 1.5, "pitch_deg": -3.25,
}  # fmt: skip


def test_a_sample() -> None:
    assert parse(FAST) == parse(FAST + b"\r") == Motion(17, 1234, MOTION)


def test_a_summary() -> None:
    report = parse(SLOW)
    assert isinstance(report, Summary)
    assert (report.number, report.mcu_ms) == (18, 1300)
    assert report.values["gyro_bias_y_dps"] == -0.2
    assert report.values["accel_norm_g"] == 1.001
    counts = {name: report.values[name] for name in ("samples_ok", "samples_error", "calibration_samples")}
    assert counts == {"samples_ok": 1000, "samples_error": 2, "calibration_samples": 200}


@pytest.mark.parametrize("line", [FAST, SLOW])
def test_every_key_must_be_there_and_be_a_number(line: bytes) -> None:
    kind, *tokens = line.split()
    for number, token in enumerate(tokens):
        key = token.split(b"=")[0]
        for wrong in (b"", key, key + b"=", key + b"=nan", key + b"=inf", key + b"=1e5", key + b"=x", key + b"=1_0"):
            report = parse(b" ".join([kind, *tokens[:number], wrong, *tokens[number + 1 :]]))
            assert isinstance(report, DeviceLogLine)
            assert report.level == logging.WARNING


@pytest.mark.parametrize(
    ("line", "text"), [(b"MPU6050 ready", "MPU6050 ready"), (b"IMU n=1", "IMU n=1"), (b"\x07x", "�x")]
)
def test_anything_else_is_a_log_line(line: bytes, text: str) -> None:
    assert parse(line) == DeviceLogLine(logging.INFO, text)


@pytest.mark.parametrize("line", [b"", b" \r"])
def test_a_blank_line_is_no_report(line: bytes) -> None:
    assert parse(line) is None


@given(st.binary(max_size=300))
def test_no_line_raises(line: bytes) -> None:
    parse(line)


def test_damaged_lines_raise_nothing() -> None:
    chance = random.Random(5)
    for _ in range(20_000):
        damaged = bytearray(chance.choice((FAST, SLOW)))
        for _ in range(chance.randint(1, 5)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        parse(bytes(damaged))


# -- the service


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig("memory", tmp_path)
    yield rig
    rig.close()


def plugged(rig: Rig) -> ScriptedMcu:
    return rig.mcu(M("unused"))


def test_samples_and_summaries_are_published(rig: Rig) -> None:
    mcu = plugged(rig)
    rig.bridge(protocol="imu_mpu6050_v1")

    def received() -> object:
        mcu.send(SLOW + b"\n", FAST + b"\r\n", SLOW + b"\n")
        time.sleep(0.05)
        return rig.world.payloads("sensors/imu")

    assert until(received)
    fast, slow = rig.world.payloads("sensors/imu-fast")[0], rig.world.payloads("sensors/imu")[0]
    assert (fast["seq"], fast["mcu_ms"], fast["value"]["orientation_deg"]) == (17, 1234, {"roll": 1.5, "pitch": -3.25})
    assert fast["value"]["gyro_dps"] == {"x": 1.25, "y": -2.0, "z": 0.0001}
    assert slow["value"]["accel_mps2"] == fast["value"]["accel_mps2"] == {"x": 0.123, "y": -0.5, "z": 9.807}
    assert slow["value"]["health"] == {
        "device": str(rig.folder / "one"), "protocol": "imu_mpu6050_v1", "instance": "one",
        "samples_ok": 1000, "samples_error": 2, "calibration_samples": 200,
    }  # fmt: skip
    topics = {message.topic.removeprefix(f"{BASE}/outgoing/"): int(message.qos) for message in rig.world.received}
    assert topics == {"sensors/imu-fast": 0, "sensors/imu": 1}


def test_silence_ends_the_process(rig: Rig) -> None:
    plugged(rig)
    running = rig.bridge(protocol="imu_mpu6050_v1", health={"imu_sample_timeout_seconds": 0.3})
    assert until(lambda: not running.alive, 6)
    assert str(running.error) == "no sample for 0.3 s"


def test_malformed_lines_are_logged_and_nothing_is_ever_sent(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    mcu = plugged(rig)
    running = rig.bridge(protocol="imu_mpu6050_v1")

    def received() -> object:
        mcu.pour(b"I n=1\n" + b"x" * 5000 + b"\n" + FAST + b"\n")  # a pty holds 4 kB until the bridge reads
        time.sleep(0.05)
        logged = [(record.getMessage(), record.levelno) for record in caplog.records]
        return rig.world.payloads("sensors/imu-fast") and ("MCU: I n=1", logging.WARNING) in logged

    assert until(received)  # what is sent while the port is being opened may be cut short
    assert running.service.counters["lines_discarded"] >= 1
    running.stop()
    assert (mcu.received, mcu.rest) == ([], b"")
