"""What an MCU calls local_only never leaves the robot: by the rule alone, and with real processes' worth of bridges."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.forwarding.forwarder import Gate
from pebble.services.mqtt_bridge.private_topics import PrivateTopics
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.serial_mcu_bridge.manifest import parse_describe
from pebble.transports import Message, MqttSettings, create
from tests.services import mcu_wire as wire
from tests.services.bridge_rig import gate_of
from tests.services.mcu_rig import BASE, Listener, Rig, Running, motion, settled
from tests.services.mcu_wire import IMU, F, I, M
from tests.support import Broker, until

OUT = f"{BASE}/outgoing"
#: One of each, private and public, and an inertial sensor whose channels are not the contract's.
SPY = M("spy-1", (
    I(1, "fast", wire.OUT, wire.KIND_SAMPLE, (F("v", wire.U8),), "lab/fast", "", wire.LOCAL_ONLY),
    I(2, "slow", wire.OUT, wire.KIND_STATE, (F("v", wire.U8),), "lab/slow", "", wire.RETAIN),
    I(3, "secret", wire.OUT, wire.KIND_STATE, (F("v", wire.U8),), "lab/secret", "", wire.RETAIN | wire.LOCAL_ONLY),
    I(4, "set", wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), "lab/set"),
    I(5, "tune", wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), "lab/tune", "", wire.LOCAL_ONLY),
    *wire.imu_interfaces(6, channels=("lab/imu-fast", "lab/imu")),
))  # fmt: skip
PRIVATE = ("mcu/spy-1/fast", "lab/fast", "mcu/spy-1/secret", "lab/secret", "mcu/spy-1/imu_fast", "lab/imu-fast")


def manifest(which: M = SPY) -> bytes:
    return msgspec.json.encode(parse_describe(which.describe()).payload())


def described(which: M = SPY, uid: str = "spy-1") -> Message:
    return Message(f"{OUT}/mcu/{uid}/describe", manifest(which), keep=True)


def sample(interface: str, uid: str = "spy-1") -> bytes:
    body = {"t": 1, "seq": 1, "mcu_ms": 1, "device_uid": uid, "interface": interface, "profile": "", "value": {"v": 1}}
    return json.dumps(body).encode()


def value(metric: str, interface: str, **more: Any) -> Message:
    return Message(f"{OUT}/{metric}", sample(interface), **more)


@pytest.fixture
def topics() -> PrivateTopics:
    return PrivateTopics(BASE)


def passed(topics: PrivateTopics, message: Message) -> list[str]:
    return [admitted.topic.removeprefix(f"{OUT}/") for admitted in topics.admit(message)]


def test_what_is_private_stays_and_what_is_not_passes(topics: PrivateTopics) -> None:
    assert passed(topics, described()) == ["mcu/spy-1/describe"]
    for metric, interface in (("mcu/spy-1/fast", "fast"), ("lab/fast", "fast"), ("mcu/spy-1/secret", "secret")):
        assert passed(topics, value(metric, interface)) == []
    for metric, interface in (("mcu/spy-1/slow", "slow"), ("lab/slow", "slow")):
        assert passed(topics, value(metric, interface)) == [metric]
    assert topics.is_known(f"{BASE}/incoming/mcu/spy-1/tune")
    assert topics.is_known(f"{BASE}/incoming/lab/tune")
    assert not topics.is_known(f"{BASE}/incoming/lab/set")


@pytest.mark.parametrize("metric", ["mcu/spy-1/fast", "lab/fast", "anywhere/else"])
def test_a_value_before_its_manifest_waits_for_no_one(topics: PrivateTopics, metric: str) -> None:
    assert passed(topics, value(metric, "fast")) == []
    assert passed(topics, described()) == ["mcu/spy-1/describe"]
    assert passed(topics, value(metric, "fast")) == []


@pytest.mark.parametrize("more", [{"retain": True}, {"keep": True}])
def test_a_kept_value_waits_for_its_manifest(topics: PrivateTopics, more: dict[str, bool]) -> None:
    """Kept copies come in any order: the state of a socket must not be lost for those who look later."""
    for metric, interface in (("mcu/spy-1/slow", "slow"), ("lab/slow", "slow"), ("lab/secret", "secret")):
        assert passed(topics, value(metric, interface, **more)) == []
    assert passed(topics, described()) == ["mcu/spy-1/describe", "mcu/spy-1/slow", "lab/slow"]
    assert passed(topics, described()) == ["mcu/spy-1/describe"]


def test_a_kept_value_that_is_taken_back_waits_no_longer(topics: PrivateTopics) -> None:
    for metric in ("mcu/spy-1/slow", "lab/slow"):
        assert passed(topics, value(metric, "slow", retain=True)) == []
        assert passed(topics, Message(f"{OUT}/{metric}", b"", keep=True)) == [metric]
    assert passed(topics, described()) == ["mcu/spy-1/describe"]


@pytest.mark.parametrize("first", ["the manifest", "the value"])
def test_what_was_said_in_private_is_not_told_when_new_firmware_is_open(topics: PrivateTopics, first: str) -> None:
    secret = value("mcu/spy-1/secret", "secret", keep=True)
    for message in (described(), secret) if first == "the manifest" else (secret, described()):
        topics.admit(message)
    opened = SPY.but(interfaces=tuple(I(**{**vars(one), "flags": wire.RETAIN}) for one in SPY.interfaces))
    assert passed(topics, described(opened)) == ["mcu/spy-1/describe"]
    assert passed(topics, secret) == ["mcu/spy-1/secret"]


def test_whose_a_uid_is_nobody_outside_asks(topics: PrivateTopics) -> None:
    assert topics.is_known(f"{BASE}/incoming/mcu/spy-1/describe")
    assert not topics.is_known(f"{BASE}/incoming/mcu/spy-1/set")
    assert not topics.is_known(f"{BASE}/outgoing/mcu/spy-1/describe")


def test_new_firmware_may_hide_what_was_public(topics: PrivateTopics) -> None:
    passed(topics, described())
    hidden = SPY.but(interfaces=(SPY.interfaces[0], I(**{**vars(SPY.interfaces[1]), "flags": wire.LOCAL_ONLY})))
    assert passed(topics, Message(f"{OUT}/mcu/spy-1/describe", b"", keep=True)) == ["mcu/spy-1/describe"]
    assert passed(topics, value("lab/slow", "slow")) == []
    passed(topics, described(hidden))
    assert passed(topics, value("lab/slow", "slow")) == []


def test_retracting_always_passes_unless_it_is_private(topics: PrivateTopics) -> None:
    passed(topics, described())
    assert passed(topics, Message(f"{OUT}/mcu/spy-1/slow", b"", keep=True)) == ["mcu/spy-1/slow"]
    assert passed(topics, Message(f"{OUT}/mcu/spy-1/secret", b"", keep=True)) == []


@pytest.mark.parametrize("payload", [b"", b"{", b'{"device_uid": 5}', b'["device_uid"]', b"\xff\xfe", sample("slow")])
def test_nonsense_is_neither_an_error_nor_held_back(topics: PrivateTopics, payload: bytes) -> None:
    passed(topics, described())
    passed(topics, Message(f"{OUT}/mcu/spy-1/describe", b"nonsense"))
    assert passed(topics, Message(f"{OUT}/strange", payload)) == ["strange"]
    assert passed(topics, value("lab/slow", "slow")) == ["lab/slow"]


def test_others_are_not_concerned(topics: PrivateTopics) -> None:
    for topic in (f"{OUT}/charging-level", f"{BASE}/incoming/drive-values", "elsewhere/entirely"):
        assert topics.admit(Message(topic, b'{"value": 1}')) == [Message(topic, b'{"value": 1}')]


def test_memory_is_bounded(topics: PrivateTopics) -> None:
    for number in range(1000):
        topics.admit(Message(f"{OUT}/mcu/u{number}/x", b"{}", keep=True))
        topics.admit(described(SPY, f"d{number}"))
    assert len(topics._waiting) <= 256
    assert len(topics._private) <= 256


# -- with real bridges


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(request.param, tmp_path)
    yield rig
    rig.close()


class World:
    """A remote broker, somebody who hears everything there, and bridges to it that come and go."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.broker = Broker(rig.folder)
        self.operator = Listener(create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=self.broker.port)))
        self.bridge: Running | None = None

    def start(self) -> None:
        section = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": self.broker.port}}
        config = self.rig.fabric.config(self.rig.folder, {}, mqtt_bridge=section)
        service = MqttBridge(config, self.rig.fabric.robots_transport(config, "local-bridge", as_published=True))
        self.bridge = Running(service)
        assert until(lambda: gate_of(service) is Gate.OPEN)

    def stop(self) -> None:
        if self.bridge is not None:
            self.bridge.stop()
            self.bridge = None

    def close(self) -> None:
        self.stop()
        self.operator.transport.close()
        self.broker.stop()


@pytest.fixture
def world(rig: Rig) -> Iterator[World]:
    world = World(rig)
    yield world
    world.close()


def test_nothing_private_leaves_the_robot_whoever_starts_first(rig: Rig, world: World) -> None:
    world.start()  # once before the MCU is known
    mcu = rig.mcu(SPY)
    line = rig.bridge()
    assert settled(rig.world, "mcu/spy-1/describe")
    mcu.stream(300, b"\1")
    assert settled(rig.world, "lab/fast")
    for round_ in range(4):  # and while it speaks
        world.stop()
        mcu.say(wire.frame(wire.STATE, bytes([round_]), 2), wire.frame(wire.STATE, bytes([round_]), 3))
        mcu.say(wire.frame(wire.SAMPLE, motion(), 6), wire.frame(wire.STATE, b"\0" * 18, 7))
        world.start()
        mcu.say(wire.frame(wire.STATE, bytes([round_ + 100]), 2), wire.frame(wire.SAMPLE, motion(), 6))
        assert until(lambda r=round_: r + 100 in [body["value"]["v"] for body in world.operator.said("lab/slow")], 5)
    mcu.unplug()
    assert until(lambda: world.operator.kept("mcu/spy-1/describe") == [])
    mcu.plug()
    assert until(lambda: world.operator.kept("mcu/spy-1/describe"))
    time.sleep(0.5)
    line.stop()
    assert until(lambda: world.operator.kept("lab/slow") == [])
    heard = {message.topic.removeprefix(f"{OUT}/") for message in world.operator.heard}
    assert {metric for metric in PRIVATE if rig.world.on(metric)} == set(PRIVATE), "on the robot all of it was there"
    assert heard & set(PRIVATE) == set()
    assert {"mcu/spy-1/slow", "lab/slow", "mcu/spy-1/describe"} <= heard


def test_a_late_operator_finds_the_kept_state_of_a_public_interface(rig: Rig, world: World) -> None:
    mcu = rig.mcu(SPY)
    rig.bridge()
    assert settled(rig.world, "mcu/spy-1/describe")
    assert rig.claimed()
    mcu.say(wire.frame(wire.STATE, b"\7", 2), wire.frame(wire.STATE, b"\7", 3))
    assert settled(rig.world, "lab/secret")
    world.start()
    assert until(lambda: world.operator.said("lab/slow") and world.operator.said("mcu/spy-1/slow"))
    assert world.operator.on("lab/secret") == []


def test_private_commands_are_for_the_robot_only(rig: Rig, world: World) -> None:
    mcu = rig.mcu(SPY)
    rig.bridge()
    world.start()
    assert settled(world.operator, "mcu/spy-1/describe")
    assert rig.claimed()

    def heard(value: int) -> list[int]:
        return [command.interface for command in mcu.commands() if command.payload == bytes([value])]

    def alias_is_heard() -> list[int]:
        """Nobody is told when an alias begins: it is tried."""
        world.operator.command("lab/set", {"v": 3})
        return heard(3)

    assert until(alias_is_heard, step=0.2)
    for metric in ("mcu/spy-1/tune", "lab/tune", "mcu/spy-1/set", "lab/set"):
        world.operator.command(metric, {"v": 1})
    assert until(lambda: len(heard(1)) == 2)
    rig.world.command("lab/tune", {"v": 2})
    assert until(lambda: heard(2))
    assert (heard(1), heard(2)) == ([4, 4], [5])


def test_the_inertial_sensor_of_the_original(rig: Rig, world: World) -> None:
    mcu = rig.mcu(IMU)
    rig.bridge()
    world.start()
    mcu.stream(100, motion())
    assert settled(rig.world, "sensors/imu-fast")
    assert settled(world.operator, "mcu/goob-imu-nano/describe")
    assert rig.claimed()
    assert world.operator.on("sensors/imu-fast") == []
    assert world.operator.on("mcu/goob-imu-nano/imu_fast") == []
