"""The simulated station of switched sockets behind its pty, seen from a host."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from pebble.errors import ConfigError
from pebble.simulation.pty import PtyMcu
from pebble.simulation.trace import read_trace
from tests.services.serial_mcu_bridge import mcu_wire as wire
from tests.support import until


class Host:
    """Sends frames, and collects those that it receives."""

    def __init__(self, link: Path) -> None:
        assert until(link.exists)
        self._port = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._received = b""

    def send(self, kind: int, payload: bytes = b"", interface: int = 0) -> None:
        os.write(self._port, wire.frame(kind, payload, interface, sequence=7))

    def received(self, kind: int) -> list[wire.Received]:
        with suppress(BlockingIOError):
            self._received += os.read(self._port, 65536)
        whole = self._received[: self._received.rfind(b"\0") + 1]
        return [one for one in map(wire.received, filter(None, whole.split(b"\0"))) if one.kind == kind]

    def close(self) -> None:
        os.close(self._port)


def relays(trace: Path) -> list[str]:
    return [entry.line for entry in read_trace(trace) if entry.event == "relay"]


@pytest.fixture
def station(tmp_path: Path) -> Iterator[PtyMcu]:
    with PtyMcu("outlets", tmp_path / "port", trace=tmp_path / "trace.jsonl") as running:
        yield running


def test_a_command_on_the_line_switches_a_relay_and_the_trace_has_it(station: PtyMcu, tmp_path: Path) -> None:
    host = Host(tmp_path / "port")
    host.send(wire.CMD, b"\1", interface=3)
    assert until(lambda: host.received(wire.ACK))
    host.send(wire.CMD, b"\0", interface=3)
    assert until(lambda: relays(tmp_path / "trace.jsonl") == ["o2 on", "o2 off"])
    host.close()


def test_only_outlets_that_are_there_can_be_taken_away(station: PtyMcu, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="outlets has no outlet 'o9'"):
        station.connect("o9", False)
    with PtyMcu("goob_imu", tmp_path / "imu") as imu, pytest.raises(ConfigError, match="goob_imu has no outlet"):
        imu.connect("o1", False)


def test_the_program_prints_what_its_relays_do(tmp_path: Path) -> None:
    link = tmp_path / "port"
    command = [sys.executable, "-m", "pebble.cli", "sim", "outlets", "--link", str(link)]
    options = ["--outlets", "2", "--unreachable", "o2", "--control"]
    with subprocess.Popen([*command, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        host = Host(link)
        assert program.stdout.readline() == f"outlets is at {link}; Ctrl-C ends it\n".encode()
        host.send(wire.CMD, b"\1", interface=1)
        assert program.stdout.readline() == b"o1 on\n"
        host.send(wire.CMD, b"\1", interface=3)
        assert until(lambda: host.received(wire.NACK))
        program.stdin.write(b"connect o2\n")
        program.stdin.flush()

        def switches_on() -> bool:  # its state shows nothing where it was away for less than 20 ms
            host.send(wire.CMD, b"\1", interface=3)
            return any(one.interface == 3 for one in host.received(wire.ACK))

        assert until(switches_on)
        assert program.stdout.readline() == b"o2 on\n"
        assert until(
            lambda: [one for one in host.received(wire.STATE) if (one.interface, one.payload) == (4, b"\1\1\1")]
        )
        host.close()
        program.stdin.close()
    assert program.returncode == 0
