"""The serial service on the memory transport and a real pty: what commands become, and what reports become."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.payloads import Drive
from pebble.services.serial_mcu_bridge.service import SerialMcuBridge
from pebble.simulation.pty import PtyMcu
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

BASE = "pebble/robots/rover"


class Bench:
    """The service in a thread of its own, an MCU, and an operator on the same fabric."""

    def __init__(self, folder: Path, kind: str, **section: Any) -> None:
        self.mcu = PtyMcu(kind, folder / "tty")
        self.mcu.__enter__()
        serial = {"enabled": True, "serial": {"port": str(folder / "tty")}, **section}
        config = parse({"robot": {"id": "rover"}, "services": {"serial_mcu_bridge": serial}}, folder=folder, env={})
        hub = MemoryHub()
        self.operator = MemoryTransport("operator", hub).open()
        self.heard: list[Message] = []
        self.operator.subscribe(f"{BASE}/outgoing/#", self.heard.append)
        self.service = SerialMcuBridge(config, MemoryTransport("robot", hub))
        self._thread = threading.Thread(target=self.service.run)
        self._thread.start()
        assert until(lambda: len(self.mcu.trace.lines()) >= 2, 5)  # stopped at the opening, and after settling

    def send(self, suffix: str, body: Any) -> None:
        self.operator.publish(f"{BASE}/{suffix}", json.dumps(body).encode(), qos=QoS.DELIVERED)

    def said(self, metric: str) -> list[Any]:
        return [json.loads(m.payload) for m in self.heard if m.topic == f"{BASE}/outgoing/{metric}"]

    def line(self, text: str) -> bool:
        return until(lambda: text in self.mcu.trace.lines(), 5)

    def close(self) -> None:
        self.service.quit()
        self._thread.join(5)
        self.operator.close()
        self.mcu.__exit__(None, None, None)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    kind, section = getattr(request, "param", ("goob", {}))
    bench = Bench(tmp_path, kind, **section)
    yield bench
    bench.close()


FRED = ("fred", {"telemetry": {"publish_touch_sensors": True}})
RENAMED = (
    "fred",
    {
        "telemetry": {"publish_touch_sensors": True},
        "topics": {
            "drive_values": "elsewhere/drive",
            "lights_solid": "elsewhere/solid",
            "lights_flash": "elsewhere/flash",
            "touch_sensors": f"{BASE}/outgoing/feelers",
            "charging_status": f"{BASE}/outgoing/dock",
        },
    },
)


def test_the_first_and_the_last_line_are_the_stop(bench: Bench) -> None:
    bench.send("incoming/drive-values", {"z": 0.5})
    assert bench.line("M 0.500 0.500")
    bench.service.quit()
    assert until(lambda: bench.mcu.trace.entries()[-1].event == "closed", 5)
    lines = bench.mcu.trace.lines()
    assert lines[0] == lines[1] == lines[-1] == "M 0.000 0.000"


@pytest.mark.parametrize("bench", [("goob", {"safety": {"drive_timeout_seconds": 0.2}})], indirect=True)
def test_the_configured_watchdog_stops_once(bench: Bench) -> None:
    bench.send("incoming/drive-values", {"z": 0.5})
    assert bench.line("M 0.500 0.500")
    moved = next(entry for entry in bench.mcu.trace.entries() if entry.line == "M 0.500 0.500")
    assert until(lambda: bench.mcu.trace.lines()[-1] == "M 0.000 0.000", 2)
    stopped = bench.mcu.trace.entries()[-1]
    assert 0.18 <= (stopped.ns - moved.ns) / 1e9 <= 0.3
    time.sleep(0.5)  # two more time-outs: one stop is enough
    assert bench.mcu.trace.entries()[-1] == stopped


def test_after_standing_still_the_stop_comes_before_the_next_command(bench: Bench) -> None:
    """As after SIGSTOP and SIGCONT: the watchdog is overdue, and a command has its turn before it."""
    bench.send("incoming/drive-values", {"z": 0.5})
    assert bench.line("M 0.500 0.500")

    def stand_still() -> None:
        time.sleep(0.9)
        bench.service.drive(Drive(x=0.0, z=0.25))

    bench.service.post(stand_still)
    assert bench.line("M 0.250 0.250")
    assert bench.mcu.trace.lines()[-3:] == ["M 0.500 0.500", "M 0.000 0.000", "M 0.250 0.250"]


@pytest.mark.parametrize("bench", [FRED], indirect=True)
def test_every_field_of_a_line_is_published(bench: Bench) -> None:
    assert until(lambda: bench.said("touch-sensors") and bench.said("charging-status"), 5)
    assert set(bench.said("touch-sensors")[0]["value"]) == {"a0", "a1", "a2"}
    assert bench.said("charging-status") == [{"value": False}]
    bench.mcu.charge(True)
    assert until(lambda: bench.said("charging-status")[-1] == {"value": True}, 5)
    assert len(bench.said("charging-status")) == 2  # only changes are told


def test_voltage_is_published_and_touch_only_if_wanted(bench: Bench) -> None:
    bench.mcu.reset()
    assert until(lambda: bench.said("charging-level"), 8)
    assert bench.said("charging-level")[0]["unit"] == "v"
    assert bench.said("touch-sensors") == []


@pytest.mark.parametrize("bench", [RENAMED], indirect=True)
def test_every_topic_can_be_renamed(bench: Bench) -> None:
    bench.operator.publish("elsewhere/drive", b'{"z": 0.25}')
    bench.operator.publish("elsewhere/solid", b'{"r": 0.5}')
    assert bench.line("M 0.250 0.250")
    assert bench.line("L 0.000 0.000 0.500")
    bench.operator.publish("elsewhere/flash", b'{"g": 0.5}')
    assert bench.line("F 0.000 0.500 0.000 2.000")
    assert until(lambda: bench.said("feelers") and bench.said("dock"), 5)
    bench.send("incoming/drive-values", {"z": 1})
    bench.operator.publish("elsewhere/solid", b'{"b": 1}')
    assert bench.line("L 1.000 0.000 0.000")
    assert "M 1.000 1.000" not in bench.mcu.trace.lines()


def test_malformed_commands_are_counted(bench: Bench) -> None:
    for _ in range(50):
        bench.operator.publish(f"{BASE}/incoming/drive-values", b'{"z": NaN}')
    bench.send("incoming/lights-solid", {"r": 1})
    assert bench.line("L 0.000 0.000 1.000")
    assert bench.service.counters["refused"] == 50
    assert set(bench.mcu.trace.lines()) == {"M 0.000 0.000", "L 0.000 0.000 1.000"}
