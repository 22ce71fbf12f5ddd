"""Goob's second board and the host's own code, without a wire between them."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, FrameError, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Manifest, parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from pebble.simulation.bodies import body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import VirtualClock

ASK = encode(Frame(Type.DESCRIBE_REQ))


class Bench:
    """A board whose loop turns every 2 ms, and a host that collects its output."""

    def __init__(self, ticks_at_boot_ms: int = 0) -> None:
        self.clock = VirtualClock()
        self.board = Board(self.clock, ticks_at_boot_ms=ticks_at_boot_ms)
        self.body: Any = body_of("goob_imu", self.board)
        self.robot = self.board.load("goob_imu", {})
        self.damaged = 0
        self._rest = b""

    def run(self, seconds: float, *, done: Callable[[list[Frame]], bool] = lambda _frames: False) -> list[Frame]:
        frames: list[Frame] = []
        until = self.clock.now() + seconds
        while self.clock.now() < until and not done(frames):
            self.clock.advance(0.002)
            self.robot.step()
            frames += self.receive()
        return frames

    def receive(self) -> list[Frame]:
        *whole, self._rest = (self._rest + self.board.take_output()).split(b"\0")
        frames = []
        for one in filter(None, whole):
            try:
                frames.append(decode(one))
            except FrameError:
                self.damaged += 1
        return frames

    def manifest(self) -> Manifest:
        self.board.type(ASK)
        return next(parse_describe(frame.payload) for frame in self.run(0.1) if frame.type is Type.DESCRIBE)


def of(frames: list[Frame], kind: Type) -> list[Frame]:
    return [frame for frame in frames if frame.type is kind]


def test_it_sends_hello_when_it_boots() -> None:
    (hello,) = of(Bench().run(0.1), Type.HELLO)
    assert parse_hello(hello.payload).device_uid == "goob-imu"
    assert hello.sequence == 1


def test_half_a_frame_from_before_a_reset_does_not_swallow_its_hello() -> None:
    """On a serial port without USB, the host has no other sign that the firmware has changed."""
    board = Board(VirtualClock())
    body_of("goob_imu", board)
    board.load("goob_imu", {}).step()
    frames = (encode(Frame(Type.SAMPLE, b"\1" * 18, 1))[:20] + board.take_output()).split(b"\0")
    assert Type.HELLO in [decode(one).type for one in frames[1:] if one]


def test_it_describes_itself_when_asked() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.board.type(ASK)
    began = bench.clock.now()
    frames = bench.run(2.0, done=lambda frames: bool(of(frames, Type.DESCRIBE)))
    assert bench.clock.now() - began < 0.05
    assert [frame.type for frame in frames if frame.type in (Type.HELLO, Type.DESCRIBE)] == [Type.HELLO, Type.DESCRIBE]
    manifest = parse_describe(frames[-1].payload)
    assert manifest.hello == parse_hello(of(frames, Type.HELLO)[0].payload)
    assert [(one.name, one.rate_hz, one.local_only) for one in manifest.interfaces] == [
        ("imu_fast", 100, True),
        ("imu", 5, False),
    ]


def test_thirty_seconds_without_loss() -> None:
    bench = Bench()
    bench.run(0.1)
    frames = bench.run(30.0)
    samples, states = of(frames, Type.SAMPLE), of(frames, Type.STATE)
    assert len(samples) in (2999, 3000, 3001)
    assert {later.sequence - one.sequence for one, later in itertools.pairwise(samples)} == {1}
    assert {later.timestamp - one.timestamp for one, later in itertools.pairwise(samples)} == {10}
    assert len(states) in (149, 150, 151)
    assert {later.sequence - one.sequence for one, later in itertools.pairwise(states)} == {1}
    assert not of(frames, Type.LOG)


def test_what_it_measures() -> None:
    bench = Bench()
    fast, slow = bench.manifest().interfaces
    bench.body.imu.tilt_deg = (30.0, -20.0)
    frames = bench.run(4.0)
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


def test_a_ping_comes_back_with_its_number() -> None:
    bench = Bench()
    bench.board.type(encode(Frame(Type.PING, sequence=0xDEADBEEF)))
    (pong,) = of(bench.run(0.1), Type.PONG)
    assert (pong.sequence, pong.interface) == (0xDEADBEEF, 0)


def test_it_refuses_commands() -> None:
    bench = Bench()
    bench.board.type(encode(Frame(Type.CMD, b"\x01", interface=3, sequence=9)))
    (nack,) = of(bench.run(0.1), Type.NACK)
    assert (nack.payload, nack.interface, nack.sequence) == (b"unknown_interface", 3, 9)


def test_a_lost_mpu_is_reported_and_found_again() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.board.bus.fail(0x68)
    lost = bench.run(2.5)
    bench.board.bus.restore(0x68)
    found = bench.run(1.5)
    assert [frame.payload for frame in of(lost, Type.LOG)] == [
        b"imu_read_failed",
        b"imu_init_failed",
        b"imu_init_failed",
    ]
    assert not of(lost[5:], Type.SAMPLE)
    assert of(lost, Type.STATE), "the state goes on"
    assert [frame.payload for frame in of(found, Type.LOG)] == [b"imu_reinit"]
    samples = of(found, Type.SAMPLE)
    assert samples[-1].sequence - samples[0].sequence == len(samples) - 1


def test_an_mpu_that_lost_its_settings_gets_them_again() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.body.imu.reset()
    frames = bench.run(1.5)
    assert [frame.payload for frame in of(frames, Type.LOG)] == [b"imu_read_failed", b"imu_reinit"]
    assert unpack(bench.manifest().interfaces[0].fields, of(frames, Type.SAMPLE)[-1].payload)["az"] > 9.0


def test_it_describes_itself_though_its_loop_is_slow() -> None:
    """Every turn brings a sample then."""
    bench = Bench()
    bench.board.type(ASK)
    frames = []
    for _ in range(20):
        bench.clock.advance(0.012)
        bench.robot.step()
        frames += bench.receive()
    assert len(of(frames, Type.DESCRIBE)) == 1
    assert len(of(frames, Type.SAMPLE)) >= 18


def test_a_board_without_an_mpu_reports_it_every_second() -> None:
    bench = Bench()
    bench.board.bus.detach(0x68)
    frames = bench.run(3.5)
    assert [frame.payload for frame in of(frames, Type.LOG)] == [b"imu_init_failed"] * 4
    bench.board.type(ASK)
    assert of(bench.run(0.1), Type.DESCRIBE)


def test_a_host_that_did_not_read_gets_the_number_of_lost_frames() -> None:
    bench = Bench()
    frames = bench.run(1.0)
    bench.board.console.reading = False
    for _ in range(1500):
        bench.clock.advance(0.002)
        bench.robot.step()
    bench.board.console.reading = True
    frames += bench.run(1.0)
    lost_counts = [
        int(frame.payload.split(b"=")[1]) for frame in of(frames, Type.LOG) if b"frames_lost=" in frame.payload
    ]
    received = len(of(frames, Type.SAMPLE)) + len(of(frames, Type.STATE))
    messages = of(frames, Type.SAMPLE)[-1].sequence + of(frames, Type.STATE)[-1].sequence
    assert len(lost_counts) == 1
    assert lost_counts[0] > 200
    assert messages - received - lost_counts[0] == bench.damaged
    assert bench.damaged <= 1, "the one that was on its way"


def test_ctrl_c_is_a_byte_like_any_other() -> None:
    bench = Bench()
    bench.board.type(b"\x03\x03\x00" + ASK)
    assert of(bench.run(0.1), Type.DESCRIBE)


def test_milliseconds_go_on_when_the_ticks_wrap() -> None:
    bench = Bench(ticks_at_boot_ms=(1 << 30) - 500)
    samples = of(bench.run(1.0), Type.SAMPLE)
    steps = {(later.timestamp - one.timestamp) % (1 << 30) for one, later in itertools.pairwise(samples)}
    assert steps == {10}


def test_hostile_input() -> None:
    bench = Bench()
    noise = random.Random(4)
    for _ in range(20_000):
        bench.board.type(noise.randbytes(noise.randrange(12)) + b"\0")
        bench.robot.step()
        bench.receive()
    assert bench.damaged == 0
    bench.board.type(b"\0")
    bench.run(1.0, done=lambda _frames: not bench.board.console.unread)
    bench.board.type(ASK)
    assert of(bench.run(0.2), Type.DESCRIBE)
