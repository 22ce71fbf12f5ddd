"""A board with its real firmware at the broker of a LAN: operators reach it by a gateway, and goob drives it.

The hub, both brokers and the gateway are processes; goob has its real `neighbours`, and no wheels.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ONLINE
from pebble.extensions.scripts.script import Robot
from pebble.transports import Message, MqttSettings, QoS, Transport, ZenohSettings, create
from pebble.transports.memory import MemoryTransport
from tests.ext.neighbours.test_service import One
from tests.firmware.wireless_rig import Robots
from tests.support import Broker, free_port, until
from tests.transports.forked import Forked

pytestmark = pytest.mark.alone
LAMP = "pebble/robots/minilamp"
GRANT = {"shares": [ONLINE.metric], "commanded": {"goob": [DRIVE.metric]}}
STOP_S = 1.0
_RUNS = itertools.count(7)  # the gateway's state has each that has begun, as long as this process


class Lan:
    """The operators' broker, the broker of a LAN with its board, and a gateway between them."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.operators, self.near = Broker(folder), Broker(folder)
        for ends in (self.operators.kill, self.near.kill):
            stack.callback(ends)
        self._hub = f"tcp/127.0.0.1:{free_port()}"
        settings = ZenohSettings(run_dir=folder / "hub", listen=(self._hub,))
        hub = Forked("pebble.extensions.lab.rig.hub", [msgspec.json.encode(settings, enc_hook=str).decode()])
        stack.callback(hub.kill)
        file = folder / "gate-1.json"
        sides = {
            side: {"host": "127.0.0.1", "port": port}
            for side, port in (("boards", self.near.port), ("mqtt", self.operators.port))
        }
        neighbours = {LAMP: {"lan": {"connect": [self._hub]}, **GRANT}}
        file.write_text(json.dumps({"id": "gate-1", **sides, "neighbours": neighbours}))
        self.gateway = Forked("tests.ext.fleet.gateway_process", str(file))
        stack.callback(self.gateway.wait, 10)
        stack.callback(self.gateway.kill)
        self.board = stack.enter_context(Robots("127.0.0.1", self.near.port, kinds=("minilamp",)))
        client = create(
            "zenoh",
            "goob-lan",
            ZenohSettings(run_dir=folder / "goob-lan", connect=(self._hub,), client=True, lease_ms=500),
        )
        self.goob = One(folder / "goob", client, "goob", stack, listens={"minilamp": [ONLINE.metric]})
        self.operator = self._client("operator", self.operators.port)
        self.received: list[tuple[float, Message]] = []
        self.operator.subscribe(f"{LAMP}/outgoing/#", self._on_received, direct=True)

    def _client(self, name: str, port: int) -> Transport:
        client = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port)).open(10)
        self._stack.callback(client.close)
        return client

    def _on_received(self, message: Message) -> None:
        self.received.append((time.monotonic(), message))

    def script(self) -> Robot:
        """A new start of a script of goob's."""
        run = next(_RUNS)
        robot = Robot(self.goob.config, MemoryTransport(f"script-{run}", self.goob.hub).open(), lambda _above: run)
        self._stack.callback(robot.close)
        assert until(lambda: robot.neighbour("minilamp").online, 20)
        return robot

    def drives(self, robot: Robot, seconds: float) -> bool:
        """Let it drive the board for so long; whether its motors ran."""
        began = time.monotonic()
        while time.monotonic() < began + seconds:
            robot.neighbour("minilamp").drive(z=0.4)
            time.sleep(0.05)
        return any(at > began and any(motors) for at, motors in list(self.board.moves["minilamp"]))

    def send(self, topic: str, payload: dict[str, object]) -> None:
        self.operator.publish(topic, json.dumps(payload).encode(), qos=QoS.DELIVERED)

    def online(self, since: float) -> bool:
        """Whether the operators receive its heartbeats now."""
        return any(at > since and one.topic == ONLINE.topic(LAMP) and not one.retain for at, one in list(self.received))

    def newest(self, metric: str) -> dict[str, object]:
        found = [one.payload for _, one in list(self.received) if one.topic == f"{LAMP}/outgoing/{metric}"]
        return json.loads(found[-1]) if found else {}


@pytest.fixture
def lan() -> Iterator[Lan]:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder, ExitStack() as stack:
        made = Lan(Path(folder), stack)
        made.board.wait_online()
        assert until(lambda: made.online(0), 20), made.gateway.printed
        yield made


def test_a_board_is_driven_by_a_neighbour_until_a_person_does(lan: Lan) -> None:
    assert until(
        lambda: (
            {CAPABILITIES.suffix, "outgoing/neighbours"}
            <= {one.topic.removeprefix(f"{LAMP}/") for _, one in lan.received}
        )
    )
    robot = lan.script()
    lamp = robot.neighbour("minilamp")
    assert until(lambda: lamp.latest(ONLINE) is not None), "goob receives what it shares"
    assert until(lambda: lan.drives(robot, 0.3))
    assert until(lambda: lan.newest("neighbours")["driven_by"] == "goob")
    lan.send(DRIVE.topic(LAMP), {"x": 0, "z": 0})
    assert until(lambda: lamp.why_refused)
    assert until(lambda: not lan.board.moving("minilamp"), STOP_S)
    assert not lan.drives(robot, 0.5), "a person has ended its run"
    time.sleep(2.0)  # which holds for this long
    again = lan.script()
    assert until(lambda: lan.drives(again, 0.3)), "a new start drives"
    lan.send(ESTOP.topic(LAMP), {"stop": "s" * 16, "by": "ann"})
    assert until(lambda: lan.newest("estop/mcu").get("latched")), "the operators' stop"
    assert not lan.drives(again, 0.5)
