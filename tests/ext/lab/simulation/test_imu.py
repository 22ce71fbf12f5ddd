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
from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import END, Frame, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
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


def test_a_host_gets_samples_on_a_grid_answers_and_reports_of_a_disturbed_bus(tmp_path: Path) -> None:
    with PtyMcu("goob_imu", tmp_path / "port") as mcu:
        host = Listener(mcu)
        host.ask(Type.DESCRIBE_REQ)
        host.ask(Type.PING)
        host.listen(1.0)
        samples, states = host.of(Type.SAMPLE), host.of(Type.STATE)
        mcu.disturb(True)
        host.listen(0.2)
        received = len(host.of(Type.SAMPLE))
        host.listen(0.2)
        assert len(host.of(Type.SAMPLE)) == received
        mcu.disturb(False)
        host.listen(1.4)
        host.close()
        assert mcu.trace.lines() == [], "what is no text is not traced as lines"
    numbers = [frame.sequence for frame in samples]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "none is lost"
    stamps = [frame.timestamp for frame in samples]
    assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) == pytest.approx(10.0, abs=0.1)
    assert (len(samples), len(states)) == (pytest.approx(100, abs=20), pytest.approx(5, abs=2))
    interface = next(one for one in parse_describe(host.of(Type.DESCRIBE)[0].payload).interfaces if one.id == 1)
    values = unpack(interface.fields, samples[-1].payload)
    assert (values["ax"], values["az"]) == (pytest.approx(0.0, abs=0.2), pytest.approx(9.81, abs=0.2))
    assert 20 < values["temp_c"] < 35
    assert host.of(Type.PONG)[0].sequence == 7
    assert len(host.of(Type.SAMPLE)) > received + 20
    assert [frame.payload for frame in host.of(Type.LOG)][-2:] == [b"imu_read_failed", b"imu_reinit"]


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
