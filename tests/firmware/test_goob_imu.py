"""Goob's second board and the host's own code, without a wire between them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from common.frames import crc16
from goob_imu.manifest import MANIFEST
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from tests.ext.boards.mcu_wire import IMU
from tests.firmware.benches import ASK, Bench, of


@pytest.fixture
def bench() -> Bench:
    return Bench("goob_imu", turn_ms=2)


def test_half_a_frame_from_before_a_reset_does_not_swallow_its_hello(bench: Bench) -> None:
    """On a serial port without USB, the host has no other sign that the firmware has changed."""
    bench.turn(0.002)
    frames = (encode(Frame(Type.SAMPLE, b"\1" * 18, 1))[:20] + bench.board.console.take_output()).split(b"\0")
    assert Type.HELLO in [decode(one).type for one in frames[1:] if one]


def test_ten_seconds_without_loss(bench: Bench) -> None:
    bench.frames(0.1)
    frames = bench.frames(10.0)
    samples, states = of(frames, Type.SAMPLE), of(frames, Type.STATE)
    assert len(samples) in (999, 1000, 1001)
    assert {later.sequence - one.sequence for one, later in pairwise(samples)} == {1}
    assert {later.timestamp - one.timestamp for one, later in pairwise(samples)} == {10}
    assert len(states) in (49, 50, 51)
    assert {later.sequence - one.sequence for one, later in pairwise(states)} == {1}
    assert not of(frames, Type.LOG)


def test_what_it_measures(bench: Bench) -> None:
    fast, slow = bench.manifest().interfaces
    bench.body.imu.tilt_deg = (30.0, -20.0)
    frames = bench.frames(4.0)
    value = unpack(fast.fields, of(frames, Type.SAMPLE)[-1].payload)
    assert value["roll_deg"] == pytest.approx(30.0, abs=1.0)
    assert value["pitch_deg"] == pytest.approx(-20.0, abs=1.0)
    assert [value[axis] for axis in ("gx", "gy", "gz")] == pytest.approx([0.0] * 3, abs=0.5)
    assert 20.0 < value["temp_c"] < 32.0
    assert value["az"] == pytest.approx(9.81 * 0.8138, abs=0.3)
    state = unpack(slow.fields, of(frames, Type.STATE)[-1].payload)
    assert state["accel_norm_g"] == pytest.approx(1.0, abs=0.03)
    assert [state[f"gyro_bias_{axis}_dps"] for axis in "xyz"] == pytest.approx(bench.body.imu.bias_dps, abs=0.05)
    assert (state["samples_error"], state["calibration_samples"]) == (0, 200)
    assert state["samples_ok"] > 390


@pytest.mark.parametrize(
    ("kind", "interface", "number", "answer", "payload"),
    [(Type.PING, 0, 0xDEADBEEF, Type.PONG, b""), (Type.CMD, 3, 9, Type.NACK, b"unknown_interface")],
)
def test_it_answers_with_the_number_of_the_question(
    bench: Bench, kind: Type, interface: int, number: int, answer: Type, payload: bytes
) -> None:
    (found,) = of(bench.asked(kind, interface=interface, sequence=number), answer)
    assert (found.payload, found.interface, found.sequence) == (payload, interface, number)


def test_a_lost_mpu_is_reported_and_found_again(bench: Bench) -> None:
    bench.frames(0.5)
    bench.board.bus.fail(0x68)
    lost = bench.frames(2.5)
    bench.board.bus.restore(0x68)
    found = bench.frames(1.5)
    assert [frame.payload for frame in of(lost, Type.LOG)] == [b"imu_read_failed"] + [b"imu_init_failed"] * 2
    assert not of(lost[5:], Type.SAMPLE)
    assert of(lost, Type.STATE), "the state goes on"
    assert [frame.payload for frame in of(found, Type.LOG)] == [b"imu_reinit"]
    samples = of(found, Type.SAMPLE)
    assert samples[-1].sequence - samples[0].sequence == len(samples) - 1


def test_a_host_that_did_not_read_gets_the_number_of_lost_frames(bench: Bench) -> None:
    frames = bench.frames(1.0)
    bench.board.console.reading = False
    bench.turn(3.0)
    bench.board.console.reading = True
    frames += bench.frames(1.0)
    logs = [frame.payload for frame in of(frames, Type.LOG)]
    (lost,) = [int(log.split(b"=")[1]) for log in logs if b"frames_lost=" in log]
    received = len(of(frames, Type.SAMPLE)) + len(of(frames, Type.STATE))
    messages = of(frames, Type.SAMPLE)[-1].sequence + of(frames, Type.STATE)[-1].sequence
    assert lost > 200
    assert messages - received - lost == bench.damaged
    assert bench.damaged <= 1, "the one that was on its way"


def test_it_describes_itself_when_asked_though_its_loop_is_slow_and_ctrl_c_is_a_byte_like_any_other() -> None:
    """Every turn brings a sample then. The question begins with 3: it would stop the board."""
    bench = Bench("goob_imu", turn_ms=12)
    assert (ASK[0], bench.robot.ctrl_c) == (3, False)
    bench.frames(0.3)
    bench.board.console.type(b"\x03\x03\x00" + ASK)
    frames = bench.frames(0.24)
    assert [frame.type for frame in frames if frame.type in (Type.HELLO, Type.DESCRIBE)] == [Type.HELLO, Type.DESCRIBE]
    assert len(of(frames, Type.SAMPLE)) >= 18
    (described,) = of(frames, Type.DESCRIBE)
    assert described.payload == MANIFEST
    assert parse_describe(MANIFEST).hello == parse_hello(of(frames, Type.HELLO)[0].payload)


def test_its_manifest_is_that_of_the_original_but_for_the_board() -> None:
    ours, original = parse_describe(MANIFEST), parse_describe(IMU.describe())
    rest = MANIFEST[49:]  # so long is HELLO, see robot.py
    assert ours.hello.schema_hash == f"goob-imu-{crc16(rest, len(rest)):04x}", "it changes with the interfaces"
    assert (ours.uid, ours.hello.model) == ("goob-imu", "seeed-xiao-samd21")
    for one, other in zip(ours.interfaces, original.interfaces, strict=True):
        fields = [replace(field, unit="") for field in one.fields]
        assert fields == [replace(field, unit="") for field in other.fields]
        assert replace(one, fields=()) == replace(other, fields=())
