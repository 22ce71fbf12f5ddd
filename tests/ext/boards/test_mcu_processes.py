"""The serial service as a process: which class is used for which protocol, and how the process ends."""

from __future__ import annotations

from pathlib import Path

from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import STATION
from tests.kit.board import ScriptedMcu
from tests.kit.robot import ProgramRobot
from tests.support import Broker, until


def test_a_terminated_process_withdraws_its_device(local: Broker, tmp_path: Path) -> None:
    mcu = ScriptedMcu(tmp_path / "port", STATION, sends_hello=True)
    line = {"enabled": True, "protocol": "pebble_serial_v1", "serial": {"port": str(mcu.link)}}
    with mcu, ProgramRobot("mqtt", local.port, {"serial_mcu_bridge": {"instances": {"sockets": line}}}) as robot:
        process = robot.run(SERIAL_PROTOCOLS["pebble_serial_v1"].service, "sockets")
        robot.world.described("hs105-sta")
        mcu.send(wire.frame(wire.STATE, b"\1\1\0", 2))
        assert robot.world.got("outlets/o1/status")
        robot.world.command("outlets/o1/power", {"on": True})
        assert until(mcu.commands)
        assert process.end() == 0
        assert robot.world.cleared("mcu/hs105-sta/describe", "outlets/o1/status", "mcu/hs105-sta/o1_state")
