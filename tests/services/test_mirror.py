"""The compatibility layer: a fabric in memory on one side, a real mosquitto and its own C clients on the other."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.forwarding.forwarder import Gate
from pebble.services.mqtt_mirror.service import MqttMirror
from pebble.transports import MqttSettings, State, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.bridge_rig import Client, Quiet, Running
from tests.support import AmqttBroker, Broker, until

DRIVE = "incoming/drive-values"
FLAG = "incoming/flags/mqtt-video"
TRUE, FALSE = b"true", b"false"
_numbers = count(1)


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.stop()


@pytest.fixture
def spare(tmp_path: Path) -> Iterator[Broker]:
    """A broker of one test's own, which forgets what it is told when it is killed."""
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


@pytest.fixture
def amqtt() -> Iterator[AmqttBroker]:
    broker = AmqttBroker()
    yield broker
    broker.stop()


class Rig:
    """One robot: a service on its fabric, a program on its broker, and the mirror in between."""

    def __init__(self, port: int, **bridge: Any) -> None:
        self.port = port
        self.robot = f"m{next(_numbers)}"
        self.base = f"pebble/robots/{self.robot}"
        self.hub = MemoryHub()
        self._bridge = bridge
        self._clients: list[Client] = []
        self._running: Running | None = None
        self.mirror: MqttMirror
        self.fabric = self._keep(Client(MemoryTransport("service", self.hub), self.base))
        self.program = self.program_client()

    def program_client(self) -> Client:
        settings = MqttSettings(host="127.0.0.1", port=self.port, as_published=True)
        name = f"{self.base}-program-{len(self._clients)}"
        return self._keep(Client(create("mqtt", name, settings), self.base))

    def start(self, *, ready: bool = True) -> MqttMirror:
        raw = {
            "robot": {"id": self.robot},
            "transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1", "port": self.port}},
            "services": {"mqtt_bridge": self._bridge},
        }
        self.mirror = MqttMirror(parse(raw, folder=Path.cwd(), env={}), MemoryTransport("mirror", self.hub))
        self._running = Running(self.mirror)
        if ready:
            assert until(lambda: self.gate is Gate.OPEN and self.mirror._forwarder.settled)
        return self.mirror

    @property
    def gate(self) -> Gate:
        return self.mirror._forwarder.gate if hasattr(self.mirror, "_forwarder") else Gate.WAITING

    def kept_on_broker(self) -> dict[str, bytes]:
        late = self.program_client()
        Quiet(late).wait(0.2)
        late.transport.close()
        return {m.topic.removeprefix(f"{self.base}/"): m.payload for m in late.seen if m.retain}

    def kept_on_fabric(self) -> dict[str, bytes]:
        return {topic.removeprefix(f"{self.base}/"): message.payload for topic, message in self.hub.kept.items()}

    def stop(self) -> None:
        if self._running is not None:
            self._running.stop()
            self._running = None

    def close(self) -> None:
        self.stop()
        for client in self._clients:
            client.transport.close()

    def _keep(self, client: Client) -> Client:
        self._clients.append(client)
        return client


Rigs = Callable[..., Rig]


@pytest.fixture
def rigs(broker: Broker) -> Iterator[Rigs]:
    made: list[Rig] = []

    def make(port: int | None = None, **bridge: Any) -> Rig:
        made.append(Rig(port or broker.port, **bridge))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


class TestBothWays:
    def test_a_program_sees_and_does_what_it_would_on_an_mqtt_robot(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        raw = bytes(range(256))
        rig.fabric.say("outgoing/wheel-odometry", raw, qos=0)
        rig.fabric.say("outgoing/sensors/imu-fast", b"fast", qos=0)
        rig.fabric.say("outgoing/status", b"state", retain=True)
        rig.fabric.say(DRIVE, b"from an operator")
        rig.program.say("incoming/lights-solid", b"from a program")
        rig.program.say("outgoing/programs/reading", raw, retain=True)
        rig.program.say(FLAG, TRUE, retain=True)
        assert until(lambda: rig.program.on(DRIVE))
        assert until(lambda: rig.fabric.on(FLAG))
        assert rig.program.payloads("outgoing/wheel-odometry") == [raw]
        assert rig.program.payloads("outgoing/sensors/imu-fast") == [b"fast"]
        assert rig.fabric.payloads("incoming/lights-solid") == [b"from a program"]
        assert rig.fabric.payloads("outgoing/programs/reading") == [raw]
        kept = {"outgoing/status": b"state", "outgoing/programs/reading": raw, FLAG: TRUE}
        assert until(lambda: rig.kept_on_broker() == kept)
        assert rig.kept_on_fabric() == kept

    def test_media_stays_away(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        for suffix in ("outgoing/front-camera", "outgoing/audio", "incoming/audio-stream"):
            rig.fabric.say(suffix, b"media", qos=0)
            rig.program.say(suffix, b"media", qos=0)
        rig.fabric.say("outgoing/status", b"after")
        rig.program.say("incoming/lights-solid", b"after")
        assert until(lambda: rig.program.on("outgoing/status") and rig.fabric.on("incoming/lights-solid"))
        assert {message.payload for message in rig.program.seen + rig.fabric.seen} == {b"after"}

    def test_a_storm_from_both_sides_comes_through_once_each_in_order(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        commands = [TRUE, FALSE] * 500
        for number, payload in enumerate(commands, 1):
            rig.fabric.say(DRIVE, payload)
            rig.program.say("incoming/lights-solid", payload)
            rig.program.say(FLAG, payload, retain=True)
            assert until(lambda: len(rig.fabric.on(FLAG)) > number - 200)  # the program's own client has limits  # noqa: B023
        assert until(lambda: len(rig.program.on(DRIVE)) >= 1000)
        assert until(lambda: len(rig.fabric.on("incoming/lights-solid")) >= 1000)
        assert until(lambda: len(rig.fabric.on(FLAG)) >= 1000)
        Quiet(rig.fabric, rig.program).wait()
        assert rig.program.payloads(DRIVE) == commands
        assert rig.fabric.payloads("incoming/lights-solid") == commands
        assert rig.fabric.payloads(FLAG) == commands
        assert not rig.fabric.on(DRIVE)
        assert not rig.program.on(FLAG)

    def test_mosquittos_own_clients(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        rig.fabric.say("outgoing/status", b'{"kept": 1}', retain=True)
        assert until(lambda: rig.program.on("outgoing/status"))
        where = ["-h", "127.0.0.1", "-p", str(rig.port)]
        sub, pub = shutil.which("mosquitto_sub"), shutil.which("mosquitto_pub")
        assert sub, "mosquitto-clients is not installed: `make test` installs it"
        assert pub
        listen = [sub, *where, "-t", f"{rig.base}/outgoing/#", "-F", "%r %t %p", "-C", "1", "-W", "10"]
        said = subprocess.run(listen, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
        assert said == f'1 {rig.base}/outgoing/status {{"kept": 1}}'
        subprocess.run([pub, *where, "-t", f"{rig.base}/{DRIVE}", "-m", '{"x": 0, "z": 1}', "-q", "1"], check=True)
        assert until(lambda: rig.fabric.payloads(DRIVE) == [b'{"x": 0, "z": 1}'])


class TestMeeting:
    def test_the_fabric_is_right_and_the_broker_fills_the_rest(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.program.say("outgoing/status", b"yesterday", retain=True)
        rig.program.say("outgoing/programs/reading", b"mine", retain=True)
        rig.program.say(FLAG, FALSE, retain=True)
        rig.program.say(DRIVE, b"stale", retain=True)
        rig.program.say("incoming/flags/reboot", TRUE, retain=True)
        rig.fabric.say("outgoing/status", b"today", retain=True)
        rig.fabric.say(FLAG, TRUE, retain=True)
        rig.fabric.say("incoming/lights-solid", b"stale", retain=True)
        rig.start()
        assert until(lambda: rig.fabric.on("outgoing/programs/reading"))
        Quiet(rig.fabric, rig.program).wait(0.8)
        right = {"outgoing/status": b"today", "outgoing/programs/reading": b"mine", FLAG: TRUE}
        kept_on_broker = rig.kept_on_broker()
        assert kept_on_broker.pop(DRIVE) == b"stale"  # not ours to remove
        assert kept_on_broker.pop("incoming/flags/reboot") == TRUE
        assert kept_on_broker == right
        assert rig.kept_on_fabric() == {**right, "incoming/lights-solid": b"stale"}
        assert {m.topic.removeprefix(f"{rig.base}/") for m in rig.fabric.seen} == {"outgoing/programs/reading"}
        assert "incoming/lights-solid" not in {m.topic.removeprefix(f"{rig.base}/") for m in rig.program.seen}

    def test_after_the_broker_was_away(self, spare: Broker, rigs: Rigs) -> None:
        rig = rigs(spare.port)
        rig.start()
        rig.fabric.say("outgoing/status", b"old", retain=True)
        rig.program.say("outgoing/programs/reading", b"1", retain=True)
        assert until(lambda: rig.program.on("outgoing/status") and rig.fabric.on("outgoing/programs/reading"))
        spare.kill()
        assert until(lambda: rig.mirror._broker.state is State.CONNECTING)
        rig.fabric.say("outgoing/status", b"new", retain=True)
        rig.fabric.say(DRIVE, b"lost")
        spare.start()
        kept = {"outgoing/status": b"new", "outgoing/programs/reading": b"1"}
        assert until(lambda: rig.kept_on_broker() == kept, 10, step=0.3)
        assert rig.kept_on_fabric() == kept
        assert not rig.program.on(DRIVE)

    def test_after_the_hub_forgot_everything(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        rig.program.say("outgoing/programs/reading", b"1", retain=True)
        rig.fabric.say("outgoing/status", b"state", retain=True)
        assert until(lambda: rig.fabric.on("outgoing/programs/reading") and rig.program.on("outgoing/status"))
        rig.hub.stop(forget=True)
        assert until(lambda: rig.mirror.transport.state is State.CONNECTING)
        rig.program.say("outgoing/programs/reading", b"2", retain=True)
        rig.hub.start()
        kept = {"outgoing/status": b"state", "outgoing/programs/reading": b"2"}
        assert until(lambda: rig.kept_on_fabric() == kept)
        assert rig.kept_on_broker() == kept


def heartbeat(age_s: float = 0.0, **more: Any) -> bytes:
    return json.dumps({"t": int((time.time() - age_s) * 1000), **more}).encode()


BRIDGE = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}}


class TestWrongBroker:
    def test_the_remote_one_is_refused(self, rigs: Rigs, caplog: pytest.LogCaptureFixture) -> None:
        rig = rigs(**BRIDGE)
        rig.program.say("outgoing/online", heartbeat(), retain=True)
        rig.start(ready=False)
        assert until(lambda: rig.gate is Gate.SHUT)
        rig.fabric.say("outgoing/status", b"1", retain=True)
        rig.program.say(DRIVE, b"1")
        Quiet(rig.fabric, rig.program).wait(0.5)
        assert not rig.fabric.on(DRIVE)
        assert not rig.program.on("outgoing/status")
        errors = [record.message for record in caplog.records if record.levelname == "ERROR"]
        assert len(errors) == 1
        assert f"127.0.0.1:{rig.port}" in errors[0]

    @pytest.mark.parametrize("sign", ["outgoing/online", "outgoing/bridge-probe"])
    def test_also_when_that_shows_later(self, rigs: Rigs, sign: str) -> None:
        rig = rigs(**BRIDGE)
        rig.start()
        rig.program.say(sign, heartbeat())
        assert until(lambda: rig.gate is Gate.SHUT)

    @pytest.mark.parametrize(
        "left_over", [heartbeat(3600), heartbeat(online=False), b"{}", b"\xff"], ids=["old", "will", "empty", "garbage"]
    )
    def test_what_is_left_over_from_other_days_does_not_count(self, rigs: Rigs, left_over: bytes) -> None:
        rig = rigs(**BRIDGE)
        rig.program.say("outgoing/online", left_over, retain=True)
        rig.start()
        rig.program.say(DRIVE, b"1")
        assert until(lambda: rig.fabric.on(DRIVE))

    def test_without_a_bridge_the_heartbeat_is_anybodys(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        rig.program.say("outgoing/online", heartbeat(), retain=True)
        assert until(lambda: rig.fabric.on("outgoing/online"))

    def test_a_broker_without_bridge_mode_is_refused(
        self, amqtt: AmqttBroker, caplog: pytest.LogCaptureFixture
    ) -> None:
        raw = {
            "robot": {"id": "m0"},
            "transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1", "port": amqtt.port}},
        }
        mirror = MqttMirror(parse(raw, folder=Path.cwd(), env={}), MemoryTransport("mirror", MemoryHub()))
        running = Running(mirror)
        assert until(lambda: any("bridge mode" in r.message for r in caplog.records if r.levelname == "ERROR"))
        running.stop()
