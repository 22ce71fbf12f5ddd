"""The simulated IMU board behind its pty, seen from a host."""

from __future__ import annotations

import os
import select
import struct
import time
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.errors import ConfigError
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import END, Frame, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from pebble.simulation.board import SimulatedMcu
from pebble.simulation.pty import PtyMcu
from tests.support import until


class Listener:
    """A host: the valid frames that it received."""

    def __init__(self, mcu: PtyMcu) -> None:
        self.frames: list[Frame] = []
        self._port = os.open(mcu.symlink, os.O_RDWR | os.O_NOCTTY)
        assert until(lambda: mcu.host)
        self._rest = b""

    def listen(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if select.select([self._port], [], [], left)[0]:
                *whole, self._rest = (self._rest + os.read(self._port, 65536)).split(END)
                self.frames += [decode(stuffed) for stuffed in whole if stuffed]

    def ask(self, kind: Type) -> None:
        os.write(self._port, encode(Frame(kind, sequence=7)))

    def of(self, kind: Type) -> list[Frame]:
        return [frame for frame in self.frames if frame.type == kind]

    def close(self) -> None:
        os.close(self._port)


def test_samples_come_at_100_hz_on_a_grid_that_does_not_drift(tmp_path: Path) -> None:
    with PtyMcu("goob_imu", tmp_path / "port") as mcu:
        host = Listener(mcu)
        host.listen(3.0)
        host.close()
        assert mcu.trace.lines() == [], "what is no text is not traced as lines"
    samples = host.of(Type.SAMPLE)
    numbers = [frame.sequence for frame in samples]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "none is lost"
    stamps = [frame.timestamp for frame in samples]
    assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) == pytest.approx(10.0, abs=0.05)
    assert max(abs((stamp - stamps[0]) % 10 - 5) for stamp in stamps) <= 5
    assert len(samples) == pytest.approx(300, abs=20)
    assert len(host.of(Type.STATE)) == pytest.approx(15, abs=2)


def test_it_describes_itself_and_measures_gravity(tmp_path: Path) -> None:
    with PtyMcu("goob_imu", tmp_path / "port") as mcu:
        host = Listener(mcu)
        host.ask(Type.DESCRIBE_REQ)
        host.ask(Type.PING)
        host.listen(0.5)
        host.close()
    manifest = parse_describe(host.of(Type.DESCRIBE)[0].payload)
    assert host.of(Type.PONG)[0].sequence == 7
    interface = next(one for one in manifest.interfaces if one.name == "imu_fast")
    values = unpack(interface.fields, host.of(Type.SAMPLE)[-1].payload)
    assert values["az"] == pytest.approx(9.81, abs=0.2)
    assert values["ax"] == pytest.approx(0.0, abs=0.2)
    assert 20 < values["temp_c"] < 35


def test_a_disturbed_bus_is_reported_and_recovers(tmp_path: Path) -> None:
    with PtyMcu("goob_imu", tmp_path / "port") as mcu:
        host = Listener(mcu)
        host.listen(0.2)
        mcu.disturb(True)
        host.listen(0.3)
        received = len(host.of(Type.SAMPLE))
        host.listen(0.3)
        assert len(host.of(Type.SAMPLE)) == received
        mcu.disturb(False)
        host.listen(1.5)
        host.close()
    assert len(host.of(Type.SAMPLE)) > received + 20
    messages = [frame.payload for frame in host.of(Type.LOG)]
    assert messages[-2:] == [b"imu_read_failed", b"imu_reinit"]


def test_two_boards_differ_by_their_uid() -> None:
    for uid in (b"one", b"two"):
        assert SimulatedMcu("goob_imu", 0.0, uid=uid).board.firmware.module("machine").unique_id() == uid


def test_a_host_that_was_away_for_a_while_misses_no_sample() -> None:
    """A wait of half a second, which is more than the scheduler of a busy machine takes away."""
    mcu = SimulatedMcu("goob_imu", 0.0)
    messages = b"".join(mcu.tick(now) for now in (0.0, 0.1, 0.55, 1.0))
    frames = [decode(stuffed) for stuffed in messages.split(END) if stuffed]
    samples = [frame.timestamp for frame in frames if frame.type == Type.SAMPLE]
    assert [b - a for a, b in pairwise(samples)] == [10] * (len(samples) - 1)
    assert len(samples) >= 98
    assert struct.calcsize("<9h") == len(next(f for f in frames if f.type == Type.SAMPLE).payload)


def test_it_has_no_failsafe() -> None:
    with pytest.raises(ConfigError, match="no motors"):
        SimulatedMcu("goob_imu", 0.0, failsafe_s=2.0)
