"""Two devices that want the same: a channel is nobody's then, a uid the first one's. On every transport."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from pebble.services.serial_mcu_bridge.manifest import parse_describe
from pebble.transports import QoS, State
from tests.services import mcu_wire as wire
from tests.services.mcu_rig import BASE, Rig, motion, settled
from tests.services.mcu_wire import IMU, LAMP, M
from tests.support import until


def imu(uid: str) -> M:
    return IMU.but(uid=uid)


def test_a_channel_that_two_claim_is_nobodys_until_one_leaves(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    one, two = rig.mcu(imu("imu-1"), "one"), rig.mcu(imu("imu-2"), "two", plugged=False)
    rig.bridge("one")
    rig.bridge("two")
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    assert settled(rig.world, "sensors/imu-fast")
    caplog.set_level(logging.INFO)
    two.plug()
    assert settled(rig.world, "mcu/imu-2/imu_fast")
    time.sleep(0.2)
    before = len(rig.world.on("sensors/imu-fast"))
    generic = len(rig.world.on("mcu/imu-1/imu_fast")), len(rig.world.on("mcu/imu-2/imu_fast"))
    time.sleep(1)
    assert len(rig.world.on("sensors/imu-fast")) == before
    assert {body["value"]["accel_mps2"]["x"] for body in rig.world.said("sensors/imu-fast")} == {1.0}
    assert len(rig.world.on("mcu/imu-1/imu_fast")) > generic[0] + 30
    assert len(rig.world.on("mcu/imu-2/imu_fast")) > generic[1] + 30
    warnings = [record.getMessage() for record in caplog.records if "both claim" in record.getMessage()]
    for claim in ("outgoing/sensors/imu-fast", "outgoing/sensors/imu"):
        told = sorted(text for text in warnings if f"claim {claim}:" in text)
        assert [text.partition(" both")[0] for text in told] == ["imu-1 and imu-2", "imu-2 and imu-1"]
    one.unplug()
    assert until(lambda: 2.0 in {body["value"]["accel_mps2"]["x"] for body in rig.world.said("sensors/imu-fast")}, 3)
    assert "imu-2: outgoing/sensors/imu-fast is ours again" in caplog.text


def test_both_at_once_and_neither_ever_speaks_there(rig: Rig) -> None:
    one, two = rig.mcu(imu("imu-1"), "one"), rig.mcu(imu("imu-2"), "two")
    rig.bridge("one")
    rig.bridge("two")
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    assert settled(rig.world, "mcu/imu-1/imu_fast")
    assert settled(rig.world, "mcu/imu-2/imu_fast")
    time.sleep(1)
    assert rig.world.on("sensors/imu-fast") == []


def test_a_contested_state_is_not_kept_and_a_contested_command_moves_nothing(rig: Rig) -> None:
    one, two = rig.mcu(LAMP, "one"), rig.mcu(LAMP.but(uid="lamp-2"), "two", plugged=False)
    rig.bridge("one")
    second = rig.bridge("two")
    assert settled(rig.world, "mcu/lamp-1/describe")
    assert rig.claimed()
    one.say(wire.frame(wire.STATE, b"\x0b", 2))
    assert settled(rig.world, "lights/lamp")
    two.plug()
    assert until(lambda: rig.world.kept("lights/lamp") == [], 3)
    assert rig.world.kept("mcu/lamp-1/lamp")
    rig.world.command("lights/lamp", {"level": 40, "on": True})
    rig.world.command("mcu/lamp-2/lamp", {"level": 1, "on": True})
    assert until(two.commands)
    assert (one.commands(), [command.payload for command in two.commands()]) == ([], [b"\2\1"])
    second.stop()
    aliases = rig.lines["one"].service._aliases  # type: ignore[attr-defined]
    assert until(lambda: "incoming/lights/lamp" in aliases._used)
    rig.world.command("lights/lamp", {"level": 40, "on": True})
    assert until(one.commands)


def test_one_uid_twice_is_the_first_ones(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    one, two = rig.mcu(IMU, "one"), rig.mcu(IMU, "two")
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    rig.bridge("one")
    rig.bridge("two")
    assert settled(rig.world, "sensors/imu-fast")
    time.sleep(1)
    heard = {body["value"]["accel_mps2"]["x"] for body in rig.world.said("sensors/imu-fast")}
    generic = {body["value"]["ax"] for body in rig.world.said("mcu/goob-imu-nano/imu_fast")}
    assert len(heard) == len(generic) == 1
    assert "goob-imu-nano: another device has this uid already" in caplog.text
    (one if heard == {1.0} else two).unplug()
    other = {1.0, 2.0} - heard
    assert until(lambda: other <= {body["value"]["accel_mps2"]["x"] for body in rig.world.said("sensors/imu-fast")}, 3)


def test_one_uid_twice_while_nobody_hears_anybody(tmp_path: Path) -> None:
    """Without a broker each finds nobody who objects. Afterwards one gives it up; what is kept is the other's."""
    with closing(Rig("mqtt", tmp_path)) as rig:
        lines = {}
        for name, level in (("one", b"\x0a"), ("two", b"\x14")):
            rig.mcu(LAMP, name, plugged=False).after_describing = wire.frame(wire.STATE, level, 2)
            lines[level[0] / 2] = rig.bridge(name).service

        def holders() -> list[float]:
            return [level for level, service in lines.items() if service._device is not None]  # type: ignore[attr-defined]

        def kept(metric: str) -> list[float]:
            return [msgspec.json.decode(raw)["value"]["level"] for raw in rig.world.kept(metric)]

        assert until(lambda: all(service.transport.state is State.CONNECTED for service in lines.values()))
        with rig.fabric.outage():
            for name in ("one", "two"):
                rig.mcus[name].plug()
            assert until(lambda: len(holders()) == 2)
        assert until(lambda: len(holders()) == 1, 15)
        assert until(lambda: rig.world.kept("mcu/lamp-1/describe"), 10)
        assert until(lambda: kept("mcu/lamp-1/lamp") == kept("lights/lamp") == holders(), 10)


def test_a_manifest_that_somebody_else_takes_back_is_said_again(rig: Rig) -> None:
    rig.mcu(LAMP)
    rig.bridge()
    assert settled(rig.world, "mcu/lamp-1/describe")
    other = rig.listener("other").transport
    other.publish(f"{BASE}/outgoing/mcu/lamp-1/describe", b"", qos=QoS.DELIVERED, retain=True)
    assert until(lambda: len(rig.world.said("mcu/lamp-1/describe")) >= 2)
    assert settled(rig.listener("late"), "mcu/lamp-1/describe")


def test_whoever_only_doubts_a_manifest_does_not_want_its_uid(memory: Rig) -> None:
    """Its question must not make a device wait that is being plugged in just now."""
    asked: list[bytes] = []
    memory.world.transport.subscribe(f"{BASE}/incoming/mcu/+/describe", lambda message: asked.append(message.payload))
    ghost = parse_describe(LAMP.but(uid="ghost").describe()).payload()
    body = msgspec.json.encode(ghost)
    memory.world.transport.publish(f"{BASE}/outgoing/mcu/ghost/describe", body, qos=QoS.DELIVERED, retain=True)
    memory.mcu(LAMP, plugged=False)
    memory.bridge()
    assert until(lambda: asked)
    assert [msgspec.json.decode(question)["from"] for question in asked] == [""]


def test_a_line_that_renames_its_channels_leaves_them_to_the_other(memory: Rig) -> None:
    rear = {"high_rate": f"{BASE}/outgoing/sensors/rear-fast", "low_rate": f"{BASE}/outgoing/sensors/rear"}
    one, two = memory.mcu(imu("imu-1"), "one"), memory.mcu(imu("imu-2"), "two")
    memory.bridge("one")
    memory.bridge("two", topics=rear)
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    assert settled(memory.world, "sensors/imu-fast")
    assert settled(memory.world, "sensors/rear-fast")
    time.sleep(0.5)
    for metric, expected in (("sensors/imu-fast", 1.0), ("sensors/rear-fast", 2.0)):
        assert {body["value"]["accel_mps2"]["x"] for body in memory.world.said(metric)} == {expected}
    interfaces = memory.world.said("mcu/imu-2/describe")[-1]["interfaces"]
    assert [interface["channel"] for interface in interfaces] == ["sensors/rear-fast", "sensors/rear"]
