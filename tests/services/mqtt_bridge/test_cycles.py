"""A bridge whose messages come back by another way: a mosquitto that forwards them too, or a second robot of its id."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.forwarding import cycles
from tests.services.mqtt_bridge import bridge_rig
from tests.services.mqtt_bridge.bridge_rig import Client, MemoryRig, MqttRig, Quiet
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy

DRIVE, MIRROR_FLAG = "incoming/drive-values", "incoming/flags/remote-mirror"
MOVE = b'{"z": 0.5}'


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


def moves(client: Client) -> int:
    return client.payloads(DRIVE).count(MOVE)


def where(port: int) -> dict[str, object]:
    return {"host": "127.0.0.1", "port": port}


class TestMosquitto:
    """The robot's broker has a ``connection`` to the operators' broker."""

    @pytest.fixture
    def remote(self, tmp_path: Path) -> Iterator[Broker]:
        broker = Broker(tmp_path)
        yield broker
        broker.kill()

    @pytest.fixture
    def other_way(self, remote: Broker) -> Iterator[TcpProxy]:
        with TcpProxy(remote.port) as proxy:
            yield proxy

    @pytest.fixture
    def rig(self, tmp_path: Path, remote: Broker, other_way: TcpProxy) -> Iterator[Callable[[str, str], MqttRig]]:
        made: list[MqttRig | Broker] = []

        def make(direction: str, carried: str) -> MqttRig:
            connection = (
                "connection other",
                f"address 127.0.0.1:{other_way.port}",
                f"topic pebble/robots/+/{carried} {direction} 1",
                "notifications false",
            )
            local = Broker(tmp_path, *connection)
            rig = MqttRig(where(local.port), where(remote.port))
            made.extend((local, rig))
            return rig

        yield make
        for part in reversed(made):
            {MqttRig: MqttRig.close, Broker: Broker.kill}[type(part)](part)

    @pytest.mark.parametrize(
        ("direction", "carried", "mirroring"),
        [("out", DRIVE, b"false"), ("in", "incoming/#", b"true"), ("both", "incoming/#", b"true")],
    )
    def test_a_drive_command_comes_to_rest(
        self,
        rig: Callable[[str, str], MqttRig],
        other_way: TcpProxy,
        caplog: pytest.LogCaptureFixture,
        monkeypatch: pytest.MonkeyPatch,
        direction: str,
        carried: str,
        mirroring: bytes,
    ) -> None:
        monkeypatch.setattr(cycles, "UNANSWERED", 1)
        robot = rig(direction, carried)
        assert until(lambda: other_way.in_use)
        robot.start()
        robot.remote.publish(MIRROR_FLAG, mirroring, retain=True)
        assert until(lambda: robot.local.on(MIRROR_FLAG))
        for _ in range(10):
            robot.remote.publish(DRIVE, MOVE)
        assert until(lambda: errors(caplog))
        Quiet(robot.local, robot.remote).wait(0.2)
        assert len(errors(caplog)) == 1
        other_way.cut()
        assert until(lambda: not robot.bridge.status.circulating)
        before = moves(robot.local)
        robot.remote.publish(DRIVE, MOVE)
        assert until(lambda: moves(robot.local) == before + 1)


def test_two_robots_of_one_id_with_crossed_brokers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = Broker(tmp_path), Broker(tmp_path)
    one = MqttRig(where(here.port), where(there.port))
    monkeypatch.setattr(bridge_rig, "_numbers", iter([int(one.base.rpartition("/r")[2])]))
    two = MqttRig(where(there.port), where(here.port))
    assert two.base == one.base
    one.start()
    two.start()
    for _ in range(5):
        one.remote.publish(DRIVE, MOVE)
        one.local.publish("outgoing/status", b"{}", retain=True)
    assert until(lambda: errors(caplog))
    Quiet(one.local, one.remote).wait(0.2)
    assert moves(one.local) < 50
    assert len(errors(caplog)) <= 2  # one of each robot
    for rig in (two, one):
        rig.close()
    for broker in (here, there):
        broker.kill()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()
