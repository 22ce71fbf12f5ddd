"""Everything the demo starts, in a folder of its own, and the order in which it ends."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from pebble.demo.broker import Broker, BrokerKind
from pebble.demo.programs import Program, end_all
from pebble.demo.robot import LinuxRobot, McuRobot, SimulatedRobot

ROBOTS = ("goob", "fred", "minilamp", "benjr")
_ROBOTS_END_S, _REST_END_S = 2.5, 1.0  # with the operator's goodbye: everything is gone within five seconds
_LONGEST_FOLDER = 40  # characters: unix sockets live below, and their paths end at 108 bytes


class Stage:
    """Two brokers, two Linux robots with an MCU each, and two robots that are an MCU.

    ``keep`` says whether the folder with the logs outlives the demo.
    """

    def __init__(self, ending: threading.Event) -> None:
        self.keep = True
        self.folder = Path(tempfile.mkdtemp(prefix="pebble-demo-", dir=_temporary_folder()))
        self.robots: Sequence[SimulatedRobot] = ()
        self.remote_port = 0
        self._ending = ending
        self._brokers: list[Program] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Robots first, while those they say their last words to are still there."""
        end_all((robot.launcher for robot in self.robots if robot.launcher is not None), _ROBOTS_END_S)
        end_all((mcu for robot in self.robots for mcu in robot.mcus), _REST_END_S)
        end_all(self._brokers, _REST_END_S)
        if not self.keep:
            shutil.rmtree(self.folder)

    def start_brokers(self, kind: BrokerKind) -> None:
        """The remote one, which operators know, and the one that Fred carries. Raises PebbleError if one fails."""
        remote, local = (Broker(name, kind, self.folder) for name in ("remote-broker", "freds-broker"))
        self._brokers = [remote.program, local.program]
        for broker in (remote, local):
            broker.wait(self._ending)
        self.remote_port = remote.port
        self.robots = [
            LinuxRobot("goob", self.folder, local.port, remote.port, has_imu=True),
            LinuxRobot("fred", self.folder, local.port, remote.port),
            McuRobot("minilamp", self.folder, "ESP32-C6", remote.port),
            McuRobot("benjr", self.folder, "ESP8266", remote.port),
        ]

    def start_robots(self) -> None:
        """Raises PebbleError if a simulated MCU fails; any other failure the operator sees, or rather does not."""
        for robot in self.robots:
            robot.start(self._ending)

    def fallen(self) -> list[str]:
        """What should still run and does not."""
        programs = [*self._brokers, *(program for robot in self.robots for program in robot.programs)]
        return [f"{program.name} ended by itself: see {program.log}" for program in programs if program.ended]


def _temporary_folder() -> str:
    usual = tempfile.gettempdir()
    return usual if len(usual) <= _LONGEST_FOLDER else "/tmp"  # noqa: S108 - mkdtemp makes a 0700 folder in it
