"""Two devices with one channel: neither gets it. Two with one uid: a warning. Our own firmware behind a pty."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.transports import QoS
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, LAMP, M, Received
from tests.kit.board import SerialRig, motion
from tests.support import cases, until


def imu(uid: str) -> M:
    return IMU.but(uid=uid)


def test_a_channel_that_two_claim_is_unused_until_one_leaves(rig: SerialRig, caplog: pytest.LogCaptureFixture) -> None:
    one, two = rig.mcu(imu("imu-1"), "one"), rig.mcu(imu("imu-2"), "two", plugged=False)
    rig.bridge("one")
    rig.bridge("two")
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    assert rig.got("sensors/imu-fast")
    caplog.set_level(logging.INFO)
    two.plug()
    assert rig.got("mcu/imu-2/imu_fast")
    time.sleep(0.1)
    before = len(rig.world.on("sensors/imu-fast"))
    due = {uid: len(rig.world.on(f"mcu/{uid}/imu_fast")) + 15 for uid in ("imu-1", "imu-2")}
    assert until(lambda: all(len(rig.world.on(f"mcu/{uid}/imu_fast")) > count for uid, count in due.items()))
    assert len(rig.world.on("sensors/imu-fast")) == before
    assert {body["value"]["accel_mps2"]["x"] for body in rig.world.payloads("sensors/imu-fast")} == {1.0}
    warnings = [record.getMessage() for record in caplog.records if "both claim" in record.getMessage()]
    for claim in ("outgoing/sensors/imu-fast", "outgoing/sensors/imu"):
        warned = sorted(text for text in warnings if f"claim {claim}:" in text)
        assert [text.partition(" both")[0] for text in warned] == ["imu-1 and imu-2", "imu-2 and imu-1"]
    one.unplug()
    assert until(
        lambda: 2.0 in {body["value"]["accel_mps2"]["x"] for body in rig.world.payloads("sensors/imu-fast")}, 3
    )
    assert "imu-2: outgoing/sensors/imu-fast is in use again" in caplog.text


def test_of_two_that_claim_one_channel_that_of_the_config_has_it(
    memory_rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    one, two = memory_rig.mcu(imu("imu-1"), "one"), memory_rig.mcu(imu("imu-2"), "two", plugged=False)
    caplog.set_level(logging.INFO)
    for name in ("one", "two"):
        memory_rig.bridge(name, aliases={"sensors/imu-fast": "imu-2"})
    one.stream(50, motion(1000))
    two.stream(50, motion(2000))
    assert memory_rig.got("mcu/imu-1/imu_fast")
    assert until(lambda: "imu-1: outgoing/sensors/imu-fast is imu-2's by the config" in caplog.text)
    assert memory_rig.world.on("sensors/imu-fast") == [], "nor before it is plugged in"
    two.plug()
    assert memory_rig.got("sensors/imu-fast")
    assert {body["value"]["accel_mps2"]["x"] for body in memory_rig.world.payloads("sensors/imu-fast")} == {2.0}
    assert not [text for text in caplog.messages if "claim outgoing/sensors/imu-fast" in text]


def test_a_contested_state_is_not_retained_and_a_contested_command_moves_nothing(rig: SerialRig) -> None:
    one, two = rig.mcu(LAMP, "one"), rig.mcu(LAMP.but(uid="lamp-2"), "two", plugged=False)
    rig.bridge("one")
    second = rig.bridge("two")
    rig.described("lamp-1")
    assert rig.claimed()
    one.send(wire.frame(wire.STATE, b"\x0b", 2))
    assert rig.got("lights/lamp")
    two.plug()
    assert rig.cleared("lights/lamp")
    assert rig.world.newest_raw("mcu/lamp-1/lamp")
    rig.world.command("lights/lamp", {"level": 40, "on": True})
    rig.world.command("mcu/lamp-2/lamp", {"level": 1, "on": True})
    assert until(two.commands)
    assert (one.commands(), [command.payload for command in two.commands()]) == ([], [b"\2\1"])
    second.stop()

    def obeys() -> list[Received]:
        """That the alias is in use again is not announced."""
        rig.world.command("lights/lamp", {"level": 40, "on": True})
        return one.commands()

    assert until(obeys, step=0.1)


def test_a_second_device_with_one_uid_is_warned_of_and_takes_nothing_along(
    rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.mcu(LAMP, "one")
    other = rig.mcu(LAMP, "two")
    rig.bridge("one")
    rig.described("lamp-1")
    assert "another device" not in caplog.text
    rig.bridge("two")
    assert until(lambda: "lamp-1: another device has this uid, too" in caplog.text)
    other.unplug()
    assert until(lambda: b"" in [message.payload for message in rig.world.on("mcu/lamp-1/describe")])
    rig.listener("late").described("lamp-1")


def test_a_manifest_cleared_by_another_is_published_again(rig: SerialRig) -> None:
    rig.mcu(LAMP)
    rig.bridge()
    rig.described("lamp-1")
    other = rig.listener("other").transport
    other.publish(f"{rig.base}/outgoing/mcu/lamp-1/describe", b"", qos=QoS.DELIVERED, retain=True)
    assert until(lambda: len(rig.world.payloads("mcu/lamp-1/describe")) >= 2)
    rig.listener("late").described("lamp-1")


FAST, SLOW = "sensors/imu-fast", "sensors/imu"
PLUGGED_IN_S = 2.0


@pytest.mark.alone
def test_found_within_two_seconds_when_plugged_in_again_and_every_sample_arrives(tmp_path: Path) -> None:
    uid = "goob-imu"
    with closing(SerialRig("zenoh", tmp_path)) as rig, PtyMcu("goob_imu", rig.folder / "imu") as board:
        running = rig.bridge("imu")
        rig.described(uid)
        board.unplug()
        assert rig.cleared(f"mcu/{uid}/describe", timeout=2)
        count, plugged = len(rig.world.on(FAST)), time.monotonic()
        board.replug()
        assert until(lambda: len(rig.world.on(FAST)) > count, 3)
        assert rig.world.at[-1] - plugged < PLUGGED_IN_S
        rig.described(uid)
        time.sleep(cases(1, 5))
        numbers = [body["seq"] for body in rig.world.payloads(FAST)[count:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len(numbers) >= 96 * cases(1, 5)
        assert until(lambda: rig.world.on(SLOW))
        fast, slow = rig.world.payloads(FAST)[-1], rig.world.payloads(SLOW)[-1]
        assert fast["value"]["accel_mps2"]["z"] == pytest.approx(9.8, abs=0.5), "the board lies flat"
        assert slow["value"]["accel_norm_g"] == pytest.approx(1.0, abs=0.05)
        assert slow["value"]["health"]["samples_error"] == 0
        assert running.alive
