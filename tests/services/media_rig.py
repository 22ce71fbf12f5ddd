"""One media program as a process of its own, with the robot's local transport and a broker for operators."""

from __future__ import annotations

from typing import Any, Self

import msgspec

from pebble.contract.payloads import MediaReport
from pebble.transports import MqttSettings, State, Transport, create
from tests.kit.robot import BASE as BASE
from tests.kit.robot import ROBOT, SILENCE_S, Program, ProgramRobot
from tests.support import until


class MediaProgram(ProgramRobot):
    """``python -m pebble.services.<name>`` of a robot with ``kind`` inside, and what it reports there.

    ``section`` of services.mqtt_bridge.media holds the ``options``; operators' requests come on ``request``.
    """

    process: Program

    def __init__(
        self, name: str, section: str, request: str, kind: str, local_port: int, remote_port: int, **options: Any
    ) -> None:
        remote = {"host": "127.0.0.1", "port": remote_port, "silence_seconds": SILENCE_S}
        bridge = {"enabled": True, "remote_mqtt": remote, "media": {section: options}}
        super().__init__(kind, local_port, {"mqtt_bridge": bridge}, robot=ROBOT)
        self.name, self._request, self.run_dir = name, request, self.config.run_dir()

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        self.process = self.run(f"pebble.services.{self.name}")

    def ask(self, **request: Any) -> None:
        """What the bridge passes on from operators."""
        self.world.command(self._request, {"enabled": True, **request})

    @property
    def reports(self) -> list[MediaReport]:
        found = self.world.on(f"media-report/{self.name}")
        return [msgspec.json.decode(message.payload, type=MediaReport) for message in found]

    @property
    def newest(self) -> MediaReport:
        """The last report; before the first one, one that says nothing."""
        return [MediaReport(running=False), *self.reports][-1]

    def reported(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Until the newest report says so."""
        return until(lambda: all(getattr(self.newest, name) == value for name, value in expected.items()), timeout)


def client(name: str, port: int) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port, silence_s=SILENCE_S)).open(10)
    assert transport.state is State.CONNECTED, transport.problem
    return transport
