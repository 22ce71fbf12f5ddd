"""The motor bridge on the memory transport and a real pty: commands become lines, reports become messages."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.config import parse
from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, ESTOP, ESTOP_RESET
from pebble.contract.payloads import Drive
from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.holders import holders
from pebble.services.serial_mcu_bridge.line.port import Port
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import handled
from tests.services.serial_mcu_bridge.motor_rig import STOPPED, Bench
from tests.support import until


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    kind, section = getattr(request, "param", ("goob", {}))
    bench = Bench(tmp_path, kind, **section)
    yield bench
    bench.close()


FRED = ("fred", {"telemetry": {"publish_touch_sensors": True}})


@pytest.mark.parametrize("bench", [("goob", {"safety": {"drive_timeout_seconds": 0.2}})], indirect=True)
def test_the_configured_watchdog_stops_once(bench: Bench) -> None:
    sent = time.monotonic()
    assert bench.moves(0.5)
    moved = next(entry for entry in bench.mcu.trace.entries() if entry.line == "M 0.500 0.500")
    assert until(lambda: bench.lines[-1] == STOPPED, 2)
    stopped = bench.mcu.trace.entries()[-1]
    assert stopped.ns / 1e9 - sent >= 0.2
    assert (stopped.ns - moved.ns) / 1e9 <= 0.5  # the default is 0.75
    time.sleep(0.5)  # two more timeouts: the stop is not repeated
    assert bench.mcu.trace.entries()[-1] == stopped


def test_after_a_pause_of_the_process_the_stop_is_sent_before_the_next_command(bench: Bench) -> None:
    """The order is that after SIGSTOP and SIGCONT: the watchdog is overdue, and a command is handled first."""
    assert bench.moves(0.5)

    def pause() -> None:
        time.sleep(0.9)
        bench.service.receive_drive(Drive(x=0.0, z=0.25), bench.service.clock())
        bench.service.judge()

    bench.service.post(pause)
    assert bench.line("M 0.250 0.250")
    assert bench.lines[-3:] == ["M 0.500 0.500", STOPPED, "M 0.250 0.250"]


def test_a_second_program_at_the_port_is_named_until_it_has_gone(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """As the original, whose unit is still enabled: it asks for no lock."""
    port = str(bench.service.options.serial.port)
    program = (
        "import os, sys, time; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(1, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, port], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"1\n"
        for _ in range(2):
            bench.service.name_holders()
            assert until(lambda: f"{port} is open in another program, too: process {other.pid} (python" in caplog.text)
        other.kill()
    assert until(lambda: holders(port) == [])
    assert caplog.text.count("is open in another program") == 1
    with pytest.raises(DeviceError, match=r"another program has it open$"):  # the bridge itself is no other one
        Port(port, 115200)


@pytest.mark.parametrize("bench", [FRED], indirect=True)
def test_every_field_of_a_line_is_published(bench: Bench) -> None:
    assert until(lambda: bench.payloads("touch-sensors") and bench.payloads("charging-status"), 5)
    assert set(bench.payloads("touch-sensors")[0]["value"]) == {"a0", "a1", "a2"}
    assert bench.payloads("charging-status") == [{"value": False}]
    bench.mcu.charge(True)
    assert until(lambda: bench.payloads("charging-status")[-1] == {"value": True}, 5)
    assert len(bench.payloads("charging-status")) == 2  # only changes are published


@pytest.mark.parametrize("bench", [FRED], indirect=True)
def test_what_the_motors_get_is_published_again_while_they_run(bench: Bench) -> None:
    """An odometry that begins while a robot drives steadily learns in which direction."""
    assert until(lambda: bench.drive(0.5) or len(bench.payloads("motor-power/serial")) >= 3, 5)
    assert {tuple(power.values()) for power in bench.payloads("motor-power/serial")} == {(0.5, 0.5)}
    assert until(lambda: bench.payloads("motor-power/serial")[-1] == {"left": 0.0, "right": 0.0}, 5)


# -- emergency stops and scripts


def test_a_drive_command_without_an_axis_is_logged_once_for_each_sender(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(60):
        bench.send("drive-values", {"linear": {"x": 1}, "source": f"s{number % 3}"})
        bench.send("drive-values", {"X": number})
    for number in range(1000):
        bench.send("drive-values", {"Z": 1, "source": f"stranger {number}"})
    assert bench.moves(0.25)
    lines = [record.getMessage() for record in caplog.records if "none of x, z and y" in record.getMessage()]
    assert [sum(f"from {name!r}" in line for line in lines) for name in ("s0", "s1", "s2")] == [1, 1, 1]
    assert sum("'X'" in line for line in lines) == 1
    assert len(lines) == 17  # 16 senders, and all others together
    assert "'linear', 'source'" in lines[0]


def test_stops_are_subscribed_to_before_drive_commands() -> None:
    assert handled(MotorBridge)[:5] == [ESTOP, ESTOP_RESET, CONTROL, CONTROL_TAKE, DRIVE]


def test_robots_with_one_state_directory_do_not_share_a_stop(tmp_path: Path) -> None:
    def bridge(robot: str) -> MotorBridge:
        serial = {"enabled": True, "serial": {"port": "/dev/null"}}
        transport = {"kind": "mqtt", "state_dir": str(tmp_path)}
        raw = {"robot": {"id": robot}, "transport": transport, "services": {"serial_mcu_bridge": serial}}
        return MotorBridge(parse(raw, folder=tmp_path, env={}), MemoryTransport(robot, MemoryHub()))

    stopped, other = bridge("rover"), bridge("other")
    stopped.state_file.save({"latched": True})
    stopped.state_file.close()
    assert (stopped.state_file.load(), other.state_file.load()) == ({"latched": True}, None)
