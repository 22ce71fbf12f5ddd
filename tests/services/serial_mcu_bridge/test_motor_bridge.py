"""The motor bridge on the memory transport and a real pty: commands become lines, reports become messages."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.contract import CONTROL, CONTROL_TAKE, CONTROL_VOUCHED, DRIVE, ESTOP, ESTOP_RESET
from pebble.contract.payloads import Drive
from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.holders import holders
from pebble.services.serial_mcu_bridge.line.port import Port
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import handled
from tests.services.serial_mcu_bridge.motor_rig import BASE, STOP, STOPPED, Bench
from tests.support import until


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    kind, section = getattr(request, "param", ("goob", {}))
    bench = Bench(tmp_path, kind, **section)
    yield bench
    bench.close()


FRED = ("fred", {"telemetry": {"publish_touch_sensors": True}})
ANN = {"id": "aaaaaaaa", "by": "ann", "device": "phone"}


@pytest.mark.parametrize("bench", [("goob", {"safety": {"drive_timeout_seconds": 0.2}})], indirect=True)
def test_the_configured_watchdog_stops_once(bench: Bench) -> None:
    sent = time.monotonic()
    assert bench.moves(0.5)
    moved = next(entry for entry in bench.mcu.trace.entries() if entry.line == "M 0.500 0.500")
    assert until(lambda: bench.lines[-1] == STOPPED, 2)
    stopped = bench.mcu.trace.entries()[-1]
    assert stopped.ns / 1e9 - sent >= 0.2
    assert (stopped.ns - moved.ns) / 1e9 <= 0.5  # the default is 0.75
    time.sleep(0.3)  # one more timeout: the stop is not repeated
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


def test_a_drive_command_without_an_axis_is_logged_once_for_each_sender(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(100):
        bench.send("drive-values", {"linear": {"x": 1}, "source": f"s{number % 3}"})
        bench.send("drive-values", {"Z": 1, "source": f"stranger {number}"})
    assert bench.moves(0.25)
    lines = [record.getMessage() for record in caplog.records if "none of x, z and y" in record.getMessage()]
    assert [sum(f"from {name!r}" in line for line in lines) for name in ("s0", "s1", "s2")] == [1, 1, 1]
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


def test_a_stop_that_is_repeated_for_another_listed_owner_is_ignored(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "goob", instance="left", peer="right")
    try:
        assert until(lambda: bench.world.on("estop/left"), 5)
        bench.send("estop", {"stop": "a" * 16, "owner": "right"})
        bench.send("control", ANN)  # judged after it
        assert bench.world.became("control/left", 5, by="ann")
        assert not bench.state["latched"]
        for number, owner in enumerate(({"owner": "left"}, {"owner": "else"}, {}), start=1):
            bench.send("estop", {"stop": f"{number:016x}", **owner})
            assert bench.world.became("estop/left", 5, latched=True, count=number)
    finally:
        bench.close()


def test_a_drive_command_that_waited_renews_control_before_the_silence_counts(bench: Bench) -> None:
    bench.send("control", {**ANN, "for_ms": 1000})
    assert bench.world.became("control/serial", 5, by="ann")
    key, began = bench.world.newest("control/serial")["key"], time.monotonic()
    assert until(lambda: time.monotonic() > began + 1.1)
    blocked, go_on, counters = threading.Event(), threading.Event(), bench.service.transport.counters

    def stand_still() -> None:
        blocked.set()
        go_on.wait(5)

    bench.service.post(stand_still)
    assert blocked.wait(5)
    delivered = counters["delivered"]
    bench.drive(0.5, key=key)
    vouched = b'{"from": 0, "to": %d}' % (1000 * time.monotonic())
    assert bench.operator.publish(CONTROL_VOUCHED.topic(BASE), vouched)
    assert until(lambda: counters["delivered"] == delivered + 2)
    go_on.set()
    assert bench.line("M 0.500 0.500")


# -- groups of commands: one write on the serial line, or nothing

HALF, LIGHTS = {"z": 0.5}, {"r": 0.2, "g": 0.7, "b": 1}
_COLOURS = (number / 1000 for number in count(1))  # each once
MOVED, LIT = "M 0.500 0.500", "L 1.000 0.700 0.200"


@pytest.fixture(scope="module")
def grouped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(tmp_path_factory.mktemp("groups"), "goob", groups=True)
    yield bench
    bench.close()


def lines_of(bench: Bench, metric: str, body: Any, least: int = 1) -> list[str]:
    """The lines that a command brings, ``least`` if any, after those of a zero and before those of plain lights."""
    bench.drive(0.0)
    assert bench.shines(b=next(_COLOURS))
    before = len(bench.lines)
    bench.send(metric, body)
    until(lambda: len(bench.lines) >= before + least, 0.3)  # the next lights replace those that wait
    assert bench.shines(b=next(_COLOURS))
    return bench.lines[before:-1]


@pytest.mark.parametrize(
    ("metric", "body", "lines"),
    [
        ("group", {"lights-solid": LIGHTS, "drive-values": HALF}, [MOVED, LIT]),
        ("group", {"drive-values": {"z": 0}, "lights-solid": LIGHTS}, [STOPPED, LIT]),
        ("group", {"lights-solid": LIGHTS}, [LIT]),
        ("group", {"drive-values": HALF, "lights-solid": LIGHTS, "estop-reset": {"boot": "", "count": 1}}, []),
        ("group", {"drive-values": {"z": 0.5, "key": "stranger"}, "lights-solid": LIGHTS}, []),
        ("drive-values", HALF | {"group": True}, []),
        ("drive-values", {"z": 0, "group": True}, [STOPPED]),
        ("lights-solid", LIGHTS | {"group": True}, []),
    ],
)
def test_a_group_is_obeyed_at_once_and_its_copies_are_not(
    grouped: Bench, metric: str, body: Any, lines: list[str]
) -> None:
    brought = lines_of(grouped, metric, body, len(lines) or 1)
    assert list(dict.fromkeys(brought)) == lines, "a zero may be repeated"


def test_no_member_is_obeyed_while_the_robot_is_stopped(grouped: Bench) -> None:
    grouped.send("estop", STOP)
    assert grouped.stopped()
    lines = lines_of(grouped, "group", {"drive-values": HALF, "lights-solid": LIGHTS})
    grouped.reset()
    assert set(lines) <= {STOPPED}


def test_without_the_key_groups_are_nothing_and_copies_are_commands(bench: Bench) -> None:
    assert MOVED not in lines_of(bench, "group", {"drive-values": HALF, "lights-solid": LIGHTS})
    assert MOVED in lines_of(bench, "drive-values", HALF | {"group": True})
