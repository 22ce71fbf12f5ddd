"""`pebble calibrate` as a process beside a robot."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.ext.scripts.script.station import Station
from tests.ext.scripts.shipped.stand_in import Sensors
from tests.support import Child, until


@pytest.fixture
def sensors() -> Iterator[Sensors]:
    station = Station("zenoh")
    sensors = Sensors(station)
    yield sensors
    sensors.close()
    station.close()


def start(sensors: Sensors, *options: str) -> Any:
    command = [sys.executable, "-m", "pebble.cli", "calibrate", "wheels", str(sensors.station.config_path), *options]
    return Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def test_an_emergency_stop_ends_it_and_nothing_is_written(sensors: Sensors) -> None:
    station, ended = sensors.station, threading.Event()
    rolling = threading.Thread(target=lambda: [sensors.roll(0.2, 0.0) for _ in iter(ended.is_set, True)])
    rolling.start()
    try:
        program = start(sensors, "--truth", "tag", "--length", "0.3")
        assert until(lambda: station.moves(), 60), program.communicate(timeout=10)[0]
        station.publish_state(latched=True, count=1, by="ann")
        assert until(station.rests, 10)
        said = program.communicate(timeout=30)[0]
    finally:
        ended.set()
        rolling.join(10)
    assert program.returncode == 3, said
    assert "emergency stop by ann" in said
    assert said.splitlines()[-1] == "pebble: ended; nothing was written"
    assert not (station.folder / "odometry.json").exists()


def test_without_a_terminal_or_hall_sensors_it_says_so(sensors: Sensors) -> None:
    said = start(sensors).communicate(timeout=60)[0]
    assert "no hall sensors: set services.serial_mcu_bridge.telemetry.publish_touch_sensors" in said
    assert said.endswith("; nothing was written\n")
