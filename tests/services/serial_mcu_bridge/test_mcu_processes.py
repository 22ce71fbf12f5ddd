"""The serial service as a process: which class is used for which protocol, and how the process ends."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.runtime.process import view_of
from pebble.services.serial_mcu_bridge.devices.described_bridge import DescribedBridge
from pebble.services.serial_mcu_bridge.serial_service import bridge_of
from pebble.services.serial_mcu_bridge.text.imu_bridge import ImuBridge
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from tests.kit.board import Rig
from tests.kit.robot import BASE
from tests.services.serial_mcu_bridge import mcu_wire as wire
from tests.services.serial_mcu_bridge.mcu_wire import STATION
from tests.support import ROOT, until


@pytest.mark.parametrize(
    ("protocol", "service"),
    [("goob_base_v1", MotorBridge), ("pebble_serial_v1", DescribedBridge), ("imu_mpu6050_v1", ImuBridge)],
)
def test_a_protocol_has_its_service(protocol: str, service: type) -> None:
    line = {"enabled": True, "protocol": protocol, "serial": {"port": "/dev/x"}}
    section: dict[str, Any] = {"instances": {"one": line}}
    raw = {"robot": {"id": "rover"}, "services": {"serial_mcu_bridge": section}}
    config = parse(raw, folder=Path("/"), env={})
    assert bridge_of(view_of(config, "one")) is service


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig("mqtt", tmp_path)
    yield rig
    rig.close()


def test_a_terminated_process_withdraws_its_device(rig: Rig) -> None:
    mcu = rig.mcu(STATION)
    line = {"enabled": True, "protocol": "pebble_serial_v1", "serial": {"port": str(mcu.link)}}
    raw = {
        "robot": {"id": BASE.split("/")[-1]},
        "transport": {"kind": "mqtt", "run_dir": str(rig.folder / "run")},
        "local_mqtt": rig.network.local_mqtt,
        "services": {"serial_mcu_bridge": {"instances": {"sockets": line}}},
    }
    path = rig.folder / "robot.json"
    path.write_text(json.dumps(raw))
    command = [sys.executable, "-m", "pebble.services.serial_mcu_bridge", str(path), "sockets"]
    with subprocess.Popen(command, cwd=ROOT) as process:
        try:
            rig.described("hs105-sta")
            mcu.send(wire.frame(wire.STATE, b"\1\1\0", 2))
            assert rig.got("outlets/o1/status")
            rig.world.command("outlets/o1/power", {"on": True})
            assert until(mcu.commands)
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(5) == 0
    for metric in ("mcu/hs105-sta/describe", "outlets/o1/status", "mcu/hs105-sta/o1_state"):
        assert until(lambda metric=metric: rig.world.retained(metric) == []), metric
