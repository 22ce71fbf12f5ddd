"""Emergency stops through bridge and mirror: live ones always pass, retained copies never, and nothing waits."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pebble.forwarding.routing import Side
from pebble.forwarding.side import Gate
from pebble.transports import QoS, State
from pebble.transports.memory import MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, MemoryRig, MqttRig, Quiet, gate_of
from tests.support import AmqttBroker, Broker, until
from tests.tcp_proxy import TcpProxy

STOP, RESET, STATE = "incoming/estop", "incoming/estop-reset", "outgoing/estop/mcu"
DRIVE = "incoming/drive-values"
MIRROR_FLAG = "incoming/flags/remote-mirror"
PRESS = b'{"stop": "00000000000000a1", "by": "test"}'
OLD = b'{"stop": "00000000000000a0", "by": "yesterday"}'
ZERO = b'{"x": 0, "z": 0, "valid_ms": 0}'
TRUE = b"true"

Rigs = Callable[..., MqttRig]


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()


@pytest.fixture(scope="module")
def brokers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Broker, Broker]]:
    """The robot's broker and the operators'."""
    folder = tmp_path_factory.mktemp("brokers")
    local, remote = Broker(folder), Broker(folder)
    yield local, remote
    local.stop()
    remote.stop()


@pytest.fixture
def link(brokers: tuple[Broker, Broker]) -> Iterator[TcpProxy]:
    """A way to the operators' broker that can fail."""
    with TcpProxy(brokers[1].port) as link:
        yield link


@pytest.fixture
def rigs() -> Iterator[Rigs]:
    """Makes rigs that end with the test."""
    made: list[MqttRig] = []

    def make(local: dict[str, Any], remote: dict[str, Any], **more: Any) -> MqttRig:
        made.append(MqttRig(local, remote, **more))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def at(broker: Broker | AmqttBroker, **more: Any) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": broker.port, **more}


def after_all(speaker: Client, listener: Client) -> None:
    """Wait until earlier messages of ``speaker`` have passed, if they do."""
    mark = b"%d" % len(listener.seen)
    speaker.publish("incoming/lights-solid", mark)
    assert until(lambda: mark in listener.payloads("incoming/lights-solid"))


def reconnected(rig: MqttRig, epoch: int) -> bool:
    """Whether the bridge has subscribed on a connection after ``epoch``."""
    return rig.bridge.status.epoch > epoch and len(rig.bridge.status.synchronized) == 2


class TestUrgency:
    def test_a_stop_is_published_by_the_thread_that_received_it(
        self, memory: MemoryRig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """No queue and no other thread is in between, so nothing can delay it or take its place."""
        memory.bridge()
        threads: list[str] = []
        publish = MemoryTransport.publish

        def record(transport: MemoryTransport, topic: str, *arguments: Any, **options: Any) -> bool:
            if topic.endswith(STOP) and transport is memory.robot_side:
                threads.append(threading.current_thread().name)
                assert options["urgent"]
                assert options["qos"] is QoS.DELIVERED
            return publish(transport, topic, *arguments, **options)

        monkeypatch.setattr(MemoryTransport, "publish", record)
        memory.remote.publish(STOP, PRESS, qos=0)
        assert until(lambda: memory.local.on(STOP))
        assert threads == ["pebble-memory remote-bridge"]

    @pytest.mark.parametrize("retain", [False, True])
    def test_it_waits_for_no_lock_of_retained_messages(self, memory: MemoryRig, *, retain: bool) -> None:
        bridge = memory.bridge()
        held, over = threading.Event(), threading.Event()

        def hold(_topic: str) -> bool:
            held.set()
            return over.wait(10)

        holding = partial(bridge.forwarder.retained.remove, Side.REMOTE, f"{BASE}/{STATE}", unless=hold)
        threading.Thread(target=holding, daemon=True).start()
        assert held.wait(5)
        memory.remote.publish(STOP, PRESS, retain=retain)
        memory.remote.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: memory.local.payloads(STOP) == [PRESS], 5)
        assert not memory.local.on(MIRROR_FLAG)
        over.set()
        assert until(lambda: memory.local.on(MIRROR_FLAG))


class TestRetain:
    """What asks to be retained, on connections that show it for live messages, too, and on those that do not."""

    @pytest.mark.parametrize("protocol", ["3.1.1", "5"])
    def test_a_live_stop_passes_unmarked_and_a_reset_does_not(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, protocol: str
    ) -> None:
        rig = rigs(at(brokers[0], protocol=protocol), at(brokers[1], protocol=protocol))
        rig.start()
        assert rig.bridge.remote.as_published
        rig.remote.publish(STOP, PRESS, retain=True)
        rig.remote.publish(STOP, PRESS, retain=True)
        rig.remote.publish(RESET, b"{}", retain=True)
        rig.remote.publish(RESET, b"live")
        after_all(rig.remote, rig.local)
        assert [(m.payload, m.qos, m.retain) for m in rig.local.on(STOP)] == [(PRESS, QoS.DELIVERED, False)] * 2
        assert rig.local.payloads(RESET) == [b"live"]
        assert STOP not in rig.retained("local")
        assert not rig.remote.on(STOP)

    @pytest.mark.parametrize("protocol", ["3.1.1", "5"])
    def test_a_retained_copy_passes_at_no_connect(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy, protocol: str
    ) -> None:
        rig = rigs(at(brokers[0], protocol=protocol), at(brokers[1], protocol=protocol), uplink=link.port)
        rig.remote.publish(STOP, OLD, retain=True)
        rig.remote.publish(RESET, b"{}", retain=True)
        rig.start()
        for _ in range(3):
            after_all(rig.remote, rig.local)
            epoch = rig.bridge.status.epoch
            link.drop()
            assert until(lambda epoch=epoch: reconnected(rig, epoch))  # type: ignore[misc]
        Quiet(rig.local, rig.remote).wait(0.7)
        assert not rig.local.on(STOP)
        assert not rig.local.on(RESET)

    @pytest.mark.parametrize("others", [0, 300])
    def test_a_retained_copy_passes_on_no_slow_link(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy, others: int
    ) -> None:
        """A broker sends few retained messages at a time: the last ones arrive many round trips after the first."""
        link.delay_s = 0.1
        rig = rigs(at(brokers[0]), at(brokers[1]), uplink=link.port)
        for number in range(others):
            rig.remote.publish(f"incoming/flags/f{number}", TRUE, retain=True)
        rig.remote.publish(STOP, OLD, retain=True)
        rig.start(ready=False)

        def arrived() -> int:
            counted = rig.bridge.forwarder.counters.snapshot()
            return sum(number for name, number in counted.items() if name.startswith("remote: "))

        assert until(lambda: arrived() >= others, 30)
        rig.wait_ready()
        Quiet(rig.local, rig.remote).wait(0.7)
        assert not rig.local.on(STOP)
        rig.remote.publish(STOP, PRESS)
        assert until(lambda: rig.local.payloads(STOP) == [PRESS])

    def test_the_same_where_the_broker_hides_it(self, brokers: tuple[Broker, Broker], rigs: Rigs) -> None:
        amqtt = AmqttBroker()
        try:
            rig = rigs(at(brokers[0]), at(amqtt))
            rig.remote.publish(STOP, OLD, retain=True)
            rig.start()
            assert not rig.bridge.remote.as_published
            rig.remote.publish(STOP, PRESS, retain=True)
            assert until(lambda: rig.local.on(STOP))
            Quiet(rig.local, rig.remote).wait()
            assert rig.local.payloads(STOP) == [PRESS]
            assert STOP not in rig.retained("local")
        finally:
            amqtt.stop()

    def test_a_copy_that_a_new_subscription_brings_does_not_pass(
        self, brokers: tuple[Broker, Broker], rigs: Rigs
    ) -> None:
        """After the gate was shut the bridge subscribes anew, on connections that have been up for long."""
        rig = rigs(at(brokers[0]), at(brokers[1]))
        bridge = rig.start()
        rig.local.publish(STOP, OLD, retain=True)
        rig.remote.publish(STOP, OLD, retain=True)
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.local.on(STOP) and bridge.forwarder.mirroring)
        bridge.forwarder.shut()
        bridge.post(bridge.disable)
        bridge.post(partial(bridge.check_again, bridge.status.epoch))
        assert until(lambda: gate_of(bridge) is Gate.OPEN and Side.REMOTE in bridge.status.subscribed)
        Quiet(rig.local, rig.remote).wait(0.7)
        assert rig.local.payloads(STOP) == [OLD]  # the live one
        assert not rig.remote.on(STOP)


class TestStates:
    def test_are_retained_at_the_remote_broker_through_reconnects(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy
    ) -> None:
        rig = rigs(at(brokers[0]), at(brokers[1]), uplink=link.port)
        rig.local.publish(STATE, b"free", retain=True)
        rig.start()
        assert until(lambda: rig.remote.payloads(STATE) == [b"free"])
        link.cut()
        assert until(lambda: rig.bridge.remote.state is State.CONNECTING)
        for payload in (b"latched", b"latched and saved"):
            rig.local.publish(STATE, payload, retain=True)
        link.mend()
        assert until(lambda: rig.remote.payloads(STATE)[-1] == b"latched and saved")
        assert rig.retained("remote")[STATE] == b"latched and saved"
        assert not rig.local.on(STATE)

    def test_a_broker_restored_from_an_older_save_stops_nothing_and_gets_the_next_state(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, tmp_path: Path
    ) -> None:
        remote = Broker(tmp_path, persistence=True)
        rig = rigs(at(brokers[0]), at(remote))
        rig.start()
        rig.remote.publish(STOP, OLD, retain=True)
        rig.local.publish(STATE, b"latched", retain=True)
        assert until(lambda: rig.local.on(STOP) and rig.remote.on(STATE))
        remote.save()
        saved = tmp_path / f"store-{remote.port}" / "mosquitto.db"
        older = saved.read_bytes()
        rig.remote.publish(STOP, b"", retain=True)
        rig.local.publish(STATE, b"free", retain=True)
        assert until(lambda: rig.remote.payloads(STATE)[-1] == b"free" and rig.local.payloads(STOP)[-1] == b"")
        before = len(rig.local.on(STOP))
        epoch = rig.bridge.status.epoch
        rig.remote.transport.close()
        remote.kill()
        saved.write_bytes(older)
        remote.start()
        assert until(lambda: reconnected(rig, epoch))
        Quiet(rig.local).wait(0.7)
        assert len(rig.local.on(STOP)) == before
        assert rig.retained("remote")[STOP] == OLD  # the broker has it again
        rig.local.publish(STATE, b"free, and published again", retain=True)
        assert until(lambda: rig.retained("remote")[STATE] == b"free, and published again", 10, step=0.3)
        rig.stop()
        remote.stop()


class TestNothingCirculates:
    @pytest.mark.parametrize("protocol", ["3.1.1", "5"])
    @pytest.mark.parametrize("retain", [False, True])
    def test_with_everything_mirrored(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, protocol: str, *, retain: bool
    ) -> None:
        rig = rigs(at(brokers[0], protocol=protocol), at(brokers[1], protocol=protocol))
        rig.start()
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.bridge.forwarder.mirroring)
        presses = [b'{"stop": "%016x"}' % number for number in range(50)]
        for press in presses:
            rig.local.publish(STOP, press, retain=retain)
            rig.remote.publish(STOP, press, retain=retain)
            rig.local.publish(DRIVE, ZERO)
            rig.remote.publish(DRIVE, ZERO)
        assert until(lambda: len(rig.remote.on(DRIVE)) >= 50 and len(rig.local.on(DRIVE)) >= 50)
        Quiet(rig.local, rig.remote).wait(1.0)
        for side in (rig.local, rig.remote):
            assert side.payloads(STOP) == presses
            assert side.payloads(DRIVE) == [ZERO] * 50
            assert not any(message.retain for message in side.on(STOP))

    def test_with_one_broker_for_both_sides(self, brokers: tuple[Broker, Broker], rigs: Rigs) -> None:
        rig = rigs({"host": "localhost", "port": brokers[0].port}, at(brokers[0]))
        rig.remote.publish(MIRROR_FLAG, TRUE, retain=True)
        rig.start()
        assert gate_of(rig.bridge) is Gate.SHUT
        rig.remote.publish(STOP, PRESS)
        rig.remote.publish(STOP, PRESS, retain=True)
        rig.local.publish(STATE, b"latched", retain=True)
        assert until(lambda: rig.remote.on(STATE))
        Quiet(rig.local, rig.remote).wait(1.0)
        assert rig.local.payloads(STOP) == [PRESS] * 2
        assert rig.remote.payloads(STATE) == [b"latched"]
