"""The mirror: a local transport in memory on one side, a real mosquitto and its own C clients on the other."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.forwarding import service as service_module
from pebble.forwarding import side as side_module
from pebble.forwarding.probes import PROBE_REQUEST
from pebble.forwarding.routing import Side
from pebble.forwarding.side import Gate
from pebble.services import mqtt_mirror as mirror_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.mqtt_mirror import MqttMirror
from pebble.transports import MqttSettings, State, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet, Running, gate_of
from tests.services.mqtt_bridge.restoring import FALSE as OFF
from tests.services.mqtt_bridge.restoring import HISTORIES, OwnBroker, play
from tests.services.mqtt_bridge.restoring import TRUE as ON
from tests.support import AmqttBroker, Broker, free_port, some, until
from tests.tcp_proxy import BridgelessProxy, TcpProxy

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
    """A broker of one test's own, which loses its messages when it is killed."""
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


@pytest.fixture
def amqtt() -> Iterator[AmqttBroker]:
    broker = AmqttBroker()
    yield broker
    broker.stop()


class Rig:
    """One robot: a service on its local transport, a program on its broker, and the mirror in between."""

    def __init__(self, port: int, **bridge: Any) -> None:
        self.port = self.mirror_port = port
        self.robot = f"m{next(_numbers)}"
        self.base = f"pebble/robots/{self.robot}"
        self.hub = MemoryHub()
        self._bridge = bridge
        self._clients: list[Client] = []
        self._running: list[Running] = []
        self.mirror: MqttMirror
        self.local = self._keep(Client(MemoryTransport("service", self.hub), self.base))
        self.program = self.program_client()

    def program_client(self) -> Client:
        settings = MqttSettings(host="127.0.0.1", port=self.port, as_published=True)
        name = f"{self.base}-program-{len(self._clients)}"
        return self._keep(Client(create("mqtt", name, settings), self.base))

    def start(self, *, ready: bool = True) -> MqttMirror:
        self.mirror = MqttMirror(self._config(), MemoryTransport("mirror", self.hub))
        self._running.append(Running(self.mirror))
        if ready:
            self.wait_ready()
        return self.mirror

    def wait_ready(self) -> None:
        assert until(lambda: self.gate is Gate.OPEN and len(self.mirror.status.synchronized) == 2)

    def start_bridge(self) -> MqttBridge:
        bridge = MqttBridge(self._config(), MemoryTransport("local-bridge", self.hub))
        self._running.append(Running(bridge))
        assert until(lambda: gate_of(bridge) is Gate.OPEN and Side.REMOTE in bridge.status.subscribed)
        return bridge

    def _config(self) -> Config:
        raw = {
            "robot": {"id": self.robot},
            "transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1", "port": self.mirror_port}},
            "services": {"mqtt_bridge": self._bridge},
        }
        return parse(raw, folder=Path.cwd(), env={})

    @property
    def gate(self) -> Gate:
        return self.mirror.forwarder.gate

    def retained_on_broker(self) -> dict[str, bytes]:
        late = self.program_client()
        Quiet(late).wait(0.2)
        late.transport.close()
        return {m.topic.removeprefix(f"{self.base}/"): m.payload for m in late.seen if m.retain}

    def retained_on_local(self) -> dict[str, bytes]:
        return {topic.removeprefix(f"{self.base}/"): message.payload for topic, message in self.hub.retained.items()}

    def stop(self) -> None:
        while self._running:
            self._running.pop().stop()

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
        rig.local.publish("outgoing/wheel-odometry", raw, qos=0)
        rig.local.publish("outgoing/sensors/imu-fast", b"fast", qos=0)
        rig.local.publish("outgoing/status", b"state", retain=True)
        rig.local.publish(DRIVE, b"from an operator")
        rig.program.publish("incoming/lights-solid", b"from a program")
        rig.program.publish("outgoing/programs/reading", raw, retain=True)
        rig.program.publish(FLAG, TRUE, retain=True)
        assert until(lambda: rig.program.on(DRIVE))
        assert until(lambda: rig.local.on(FLAG))
        assert rig.program.payloads("outgoing/wheel-odometry") == [raw]
        assert rig.program.payloads("outgoing/sensors/imu-fast") == [b"fast"]
        assert rig.local.payloads("incoming/lights-solid") == [b"from a program"]
        assert rig.local.payloads("outgoing/programs/reading") == [raw]
        retained = {"outgoing/status": b"state", "outgoing/programs/reading": raw, FLAG: TRUE}
        assert until(lambda: rig.retained_on_broker() == retained)
        assert rig.retained_on_local() == retained

    def test_a_live_stop_passes_even_if_it_asks_to_be_retained_and_a_retained_copy_does_not(self, rigs: Rigs) -> None:
        rig = rigs()
        for client in (rig.local, rig.program):
            client.publish("incoming/estop", b"old", retain=True)
        rig.start()
        assert until(lambda: len(rig.mirror.status.synchronized) == 2)
        for side, client in (("local", rig.local), ("program", rig.program)):
            client.publish("incoming/estop", f"from {side}".encode(), retain=True)
            client.publish("incoming/estop-reset", b"retained", retain=True)
            client.publish("incoming/estop-reset", f"from {side}".encode())
        rig.local.publish("outgoing/estop/mcu", b"latched", retain=True)
        assert until(lambda: rig.program.on("incoming/estop-reset") and rig.local.on("incoming/estop-reset"))
        Quiet(rig.local, rig.program).wait()
        assert rig.program.payloads("incoming/estop") == rig.program.payloads("incoming/estop-reset") == [b"from local"]
        assert rig.local.payloads("incoming/estop") == rig.local.payloads("incoming/estop-reset") == [b"from program"]
        assert rig.retained_on_broker()["outgoing/estop/mcu"] == b"latched"
        assert rig.retained_on_local()["incoming/estop"] == b"from local"  # its publisher's, not the mirror's

    def test_a_storm_from_both_sides_comes_through_once_each_in_order(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        commands = [TRUE, FALSE] * 500
        for number, payload in enumerate(commands, 1):
            rig.local.publish(DRIVE, payload)
            rig.program.publish("incoming/lights-solid", payload)
            rig.program.publish(FLAG, payload, retain=True)
            assert until(lambda: len(rig.local.on(FLAG)) > number - 200)  # the program's own client has limits  # noqa: B023
        assert until(lambda: len(rig.program.on(DRIVE)) >= 1000)
        assert until(lambda: len(rig.local.on("incoming/lights-solid")) >= 1000)
        assert until(lambda: len(rig.local.on(FLAG)) >= 1000)
        Quiet(rig.local, rig.program).wait()
        assert rig.program.payloads(DRIVE) == commands
        assert rig.local.payloads("incoming/lights-solid") == commands
        assert rig.local.payloads(FLAG) == commands
        assert not rig.local.on(DRIVE)
        assert not rig.program.on(FLAG)

    def test_mosquittos_own_clients(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        rig.local.publish("outgoing/status", b'{"kept": 1}', retain=True)
        assert until(lambda: rig.program.on("outgoing/status"))
        where = ["-h", "127.0.0.1", "-p", str(rig.port)]
        sub, pub = shutil.which("mosquitto_sub"), shutil.which("mosquitto_pub")
        assert sub, "mosquitto-clients is not installed: `make test` installs it"
        assert pub
        listen = [sub, *where, "-t", f"{rig.base}/outgoing/#", "-F", "%r %t %p", "-C", "1", "-W", "10"]
        earlier = subprocess.run(listen, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
        assert earlier == f'1 {rig.base}/outgoing/status {{"kept": 1}}'
        subprocess.run([pub, *where, "-t", f"{rig.base}/{DRIVE}", "-m", '{"x": 0, "z": 1}', "-q", "1"], check=True)
        assert until(lambda: rig.local.payloads(DRIVE) == [b'{"x": 0, "z": 1}'])


class TestMeeting:
    def test_the_local_side_wins_and_the_broker_fills_the_rest(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.program.publish("outgoing/status", b"yesterday", retain=True)
        rig.program.publish("outgoing/programs/reading", b"mine", retain=True)
        rig.program.publish(FLAG, FALSE, retain=True)
        rig.program.publish(DRIVE, b"stale", retain=True)
        rig.program.publish("incoming/flags/reboot", TRUE, retain=True)
        rig.local.publish("outgoing/status", b"today", retain=True)
        rig.local.publish(FLAG, TRUE, retain=True)
        rig.local.publish("incoming/lights-solid", b"stale", retain=True)
        rig.start()
        assert until(lambda: rig.local.on("outgoing/programs/reading"))
        Quiet(rig.local, rig.program).wait(0.8)
        right = {"outgoing/status": b"today", "outgoing/programs/reading": b"mine", FLAG: TRUE}
        retained_on_broker = rig.retained_on_broker()
        assert retained_on_broker.pop(DRIVE) == b"stale"  # not ours to remove
        assert retained_on_broker.pop("incoming/flags/reboot") == TRUE
        assert retained_on_broker == right
        assert rig.retained_on_local() == {**right, "incoming/lights-solid": b"stale"}
        assert {m.topic.removeprefix(f"{rig.base}/") for m in rig.local.seen} == {"outgoing/programs/reading"}
        assert "incoming/lights-solid" not in {m.topic.removeprefix(f"{rig.base}/") for m in rig.program.seen}

    def test_after_the_broker_was_away(self, spare: Broker, rigs: Rigs) -> None:
        rig = rigs(spare.port)
        rig.start()
        rig.local.publish("outgoing/status", b"old", retain=True)
        rig.program.publish("outgoing/programs/reading", b"1", retain=True)
        assert until(lambda: rig.program.on("outgoing/status") and rig.local.on("outgoing/programs/reading"))
        spare.kill()
        assert until(lambda: rig.mirror.remote.state is State.CONNECTING)
        rig.local.publish("outgoing/status", b"new", retain=True)
        rig.local.publish(DRIVE, b"lost")
        spare.start()
        retained = {"outgoing/status": b"new", "outgoing/programs/reading": b"1"}
        assert until(lambda: rig.retained_on_broker() == retained, 10, step=0.3)
        assert rig.retained_on_local() == retained
        assert not rig.program.on(DRIVE)


@pytest.mark.parametrize("longer", [False, True], ids=["brief", "longer"])
@pytest.mark.parametrize("history", some(HISTORIES, 4))
def test_what_was_switched_off_stays_off_when_the_broker_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rigs: Rigs, history: str, longer: bool
) -> None:
    """The operator is at the robot's own side here, and programs are at the mirror's broker."""
    monkeypatch.setattr(side_module, "RESTORED_S", 0.0 if longer else 30.0)
    broker = OwnBroker(tmp_path)
    try:
        rig = rigs(broker.port)
        mirror = rig.start()
        once = rig.program_client()

        def set_flag(who: str, value: bytes) -> None:
            setter = {"operator": rig.local, "program": rig.program, "once": once}[who]
            setter.publish(FLAG, value, retain=True, remember=who != "once")
            assert until(lambda: rig.retained_on_local().get(FLAG) == rig.retained_on_broker().get(FLAG) == value)

        play(history, set_flag, broker.save)
        before, seen = mirror.remote.counters["connected"], len(rig.local.payloads(FLAG))
        broker.stop()
        assert until(lambda: mirror.remote.state is not State.CONNECTED)
        broker.restore()
        assert until(lambda: mirror.remote.counters["connected"] > before)
        Quiet(rig.local, rig.program).wait(1.0)
        assert until(lambda: rig.retained_on_broker().get(FLAG) == OFF)
        assert rig.retained_on_local()[FLAG] == OFF
        assert ON not in rig.local.payloads(FLAG)[seen:]
    finally:
        broker.stop()


def heartbeat(age_s: float = 0.0, **more: Any) -> bytes:
    return json.dumps({"t": int((time.time() - age_s) * 1000), **more}).encode()


BRIDGE = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}}


def bridge_to(port: int, **more: Any) -> dict[str, Any]:
    return {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": port}, **more}


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelname == "ERROR"]


class TestWrongBroker:
    @pytest.mark.parametrize("heartbeat", [True, False], ids=["with a heartbeat", "without"])
    @pytest.mark.parametrize("first", ["the mirror", "the bridge"])
    def test_the_remote_one_is_refused(
        self, broker: Broker, rigs: Rigs, caplog: pytest.LogCaptureFixture, first: str, heartbeat: bool
    ) -> None:
        rig = rigs(**bridge_to(broker.port, heartbeat={"enabled": heartbeat}))
        order = {
            "the mirror": (rig.start, rig.start_bridge),
            "the bridge": (rig.start_bridge, partial(rig.start, ready=False)),
        }
        for start in order[first]:
            start()
        assert until(lambda: rig.gate is Gate.SHUT)
        rig.program.publish("outgoing/programs/reading", b"1", retain=True)
        rig.program.publish(DRIVE, b"1")
        Quiet(rig.local, rig.program).wait(0.5)
        assert rig.local.payloads(DRIVE) == [b"1"]  # by the bridge
        assert not rig.local.on("outgoing/programs/reading")
        assert len(errors(caplog)) == 1
        assert f"127.0.0.1:{rig.port}" in errors(caplog)[0]

    def test_one_that_later_turns_out_to_be_the_remote_one_too(self, broker: Broker, spare: Broker, rigs: Rigs) -> None:
        """Its address may lead elsewhere after a reconnect."""
        with TcpProxy(spare.port) as uplink:
            rig = rigs(**bridge_to(uplink.port))
            rig.start_bridge()
            rig.start()
            uplink.lead_to(broker.port)
            assert until(lambda: rig.gate is Gate.SHUT)

    @pytest.mark.parametrize("retain", [False, True])
    @pytest.mark.parametrize("topic", ["outgoing/bridge-probe", "outgoing/online"])
    def test_no_client_of_it_can_stop_the_mirror(self, spare: Broker, rigs: Rigs, topic: str, retain: bool) -> None:
        rig = rigs(**bridge_to(spare.port))
        rig.start_bridge()
        rig.start()
        nonce = {"nonce": "0123456789abcdef"}
        for payload in (b"x", b"", b"x" * 100_000, heartbeat(), heartbeat(**nonce), PROBE_REQUEST):
            rig.program.publish(topic, payload, retain=retain)
        for number in range(100):
            rig.program.publish(topic, heartbeat(-number / 100), retain=retain)
        rig.program.publish(DRIVE, b"after")
        assert until(lambda: rig.local.on(DRIVE))
        Quiet(rig.local, rig.program).wait(0.5)
        assert rig.gate is Gate.OPEN

    def test_a_client_of_it_never_sees_what_would_stop_the_mirror(self, spare: Broker, rigs: Rigs) -> None:
        rig = rigs(**bridge_to(spare.port))
        rig.start_bridge()
        rig.start()
        rig.program.publish("outgoing/online", heartbeat())
        assert until(lambda: len(rig.local.on("outgoing/bridge-probe")) >= 3)  # questions of the mirror, and answers
        rig.local.publish("outgoing/status", b"after")
        assert until(lambda: rig.program.on("outgoing/status"))
        assert not rig.program.on("outgoing/bridge-probe")

    @pytest.mark.parametrize("how", ["after a while", "at a reconnect"])
    def test_it_is_checked_again(
        self, broker: Broker, spare: Broker, rigs: Rigs, monkeypatch: pytest.MonkeyPatch, how: str
    ) -> None:
        monkeypatch.setattr(service_module, "CHECK_AGAIN_S", {"after a while": 0.5, "at a reconnect": 60.0}[how])
        with TcpProxy(broker.port) as uplink, TcpProxy(broker.port) as way:
            rig = rigs(**bridge_to(uplink.port))
            rig.mirror_port = way.port
            rig.start()
            rig.local.publish("outgoing/programs/reading", b"gone", retain=True)
            rig.local.publish("outgoing/status", b"old", retain=True)
            assert until(lambda: len(rig.retained_on_broker()) == 2)
            bridge = rig.start_bridge()
            assert until(lambda: rig.gate is Gate.SHUT)
            epoch = bridge.status.epoch
            uplink.lead_to(spare.port)  # the bridge serves another broker from now on
            assert until(lambda: bridge.status.epoch > epoch)
            rig.local.publish("outgoing/programs/reading", b"", retain=True)
            rig.local.publish("outgoing/status", b"new", retain=True)
            assert until(lambda: bridge.remote.state is State.CONNECTED)
            {"after a while": lambda: None, "at a reconnect": way.drop}[how]()
            rig.wait_ready()
            rig.program.publish(DRIVE, b"1")
            assert until(lambda: rig.local.payloads(DRIVE) == [b"1"])
            online = "outgoing/online"  # the bridge was there and has left
            assert until(lambda: rig.retained_on_broker().keys() == {"outgoing/status", online}, 5), (
                rig.retained_on_broker()
            )
            assert rig.retained_on_broker()["outgoing/status"] == b"new"
            assert rig.retained_on_local() == {"outgoing/status": b"new"}

    @pytest.mark.parametrize("bridge_lives", [True, False])
    def test_it_stays_shut_while_the_broker_is_the_remote_one(
        self,
        broker: Broker,
        rigs: Rigs,
        monkeypatch: pytest.MonkeyPatch,
        caplog: pytest.LogCaptureFixture,
        bridge_lives: bool,
    ) -> None:
        """Also if the bridge cannot be asked: the earlier proof still counts."""
        monkeypatch.setattr(service_module, "CHECK_AGAIN_S", 0.1)
        monkeypatch.setattr(mirror_module, "CHECK_S", 0.3)
        with TcpProxy(broker.port) as uplink:
            rig = rigs(**bridge_to(uplink.port))
            rig.start_bridge()
            rig.start(ready=False)
            assert until(lambda: rig.gate is Gate.SHUT)
            {True: lambda: None, False: uplink.cut}[bridge_lives]()
            checks: list[int] = []
            wait = rig.mirror.forwarder.rearm
            monkeypatch.setattr(rig.mirror.forwarder, "rearm", lambda: checks.append(1) or wait())
            opened = []
            monkeypatch.setattr(rig.mirror.forwarder, "open", lambda: opened.append(1))
            assert until(lambda: len(checks) > 4)
            assert not opened
            assert len(errors(caplog)) == 1

    @pytest.mark.parametrize(
        "left_over", [heartbeat(3600), heartbeat(online=False), b"{}", b"\xff"], ids=["old", "will", "empty", "garbage"]
    )
    def test_what_is_left_over_from_other_days_does_not_count(self, rigs: Rigs, left_over: bytes) -> None:
        rig = rigs(**BRIDGE)
        rig.program.publish("outgoing/online", left_over, retain=True)
        rig.start()
        rig.program.publish(DRIVE, b"1")
        assert until(lambda: rig.local.on(DRIVE))

    def test_without_a_bridge_the_heartbeat_is_anybodys(self, rigs: Rigs) -> None:
        rig = rigs()
        rig.start()
        rig.program.publish("outgoing/online", heartbeat(), retain=True)
        assert until(lambda: rig.local.on("outgoing/online"))

    def test_a_broker_without_bridge_mode_is_refused_for_one_connection_only(
        self, broker: Broker, rigs: Rigs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(service_module, "CHECK_AGAIN_S", 60.0)
        with BridgelessProxy(broker.port) as way:
            rig = rigs()
            rig.mirror_port = way.port
            rig.start(ready=False)
            assert until(lambda: rig.gate is Gate.SHUT)
            way.bridgeless = False
            way.drop()
            rig.wait_ready()
            rig.program.publish(DRIVE, b"1")
            assert until(lambda: rig.local.payloads(DRIVE) == [b"1"])
        assert len(errors(caplog)) == 1

    def test_one_that_is_away_behind_a_proxy_is_not_refused(
        self, broker: Broker, rigs: Rigs, caplog: pytest.LogCaptureFixture
    ) -> None:
        with BridgelessProxy(broker.port) as way:
            way.bridgeless = False
            rig = rigs()
            rig.mirror_port = way.port
            rig.start()
            for more in range(3):
                way.lead_to(free_port())
                attempts = way.connections + 2 + more
                assert until(lambda: way.connections > attempts)  # noqa: B023
                way.lead_to(broker.port)
                assert until(lambda: rig.mirror.remote.state is State.CONNECTED)
            rig.wait_ready()
            rig.program.publish(DRIVE, b"1")
            assert until(lambda: rig.local.payloads(DRIVE) == [b"1"])
        assert not errors(caplog)

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
