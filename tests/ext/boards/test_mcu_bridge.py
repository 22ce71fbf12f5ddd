"""The bridges of a self-describing MCU and of an inertial sensor, on every transport and a real pty."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.runtime.parent import Notifier
from pebble.services.serial_mcu_bridge.devices import peers
from pebble.services.serial_mcu_bridge.imu import reports as imu
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import host
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, LAMP, STATION, F, I, M
from tests.kit.board import ScriptedMcu, SerialRig, motion, summary
from tests.kit.robot import ProgramRobot
from tests.services.serial_mcu_bridge.test_text_protocols import FAST, SLOW
from tests.support import WAIT_S, Broker, until


def test_the_launcher_is_notified_of_outlets_while_they_are_in_use(
    memory_rig: SerialRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, bool] = {}
    monkeypatch.setattr(Notifier, "feature", lambda _notifier, name, has: seen.update({name: has}) or True)
    mcu = memory_rig.mcu(STATION)
    memory_rig.bridge()
    features = [f"outlets/o{number}/{what}" for number in range(1, 5) for what in ("status", "power")]
    assert until(lambda: seen == dict.fromkeys(features, True))
    mcu.unplug()
    assert until(lambda: seen == dict.fromkeys(features, False))


def test_the_bodies_of_an_inertial_sensor(memory_rig: SerialRig) -> None:
    """Under its own topics and under its aliases."""
    mcu, _ = memory_rig.up(IMU)
    began = time.time_ns() // 1_000_000
    mcu.send(wire.frame(wire.STATE, summary(), 2, 7, 700))  # a summary before the first motion is not published
    mcu.send(wire.frame(wire.SAMPLE, motion(), 1, 8, 800), wire.frame(wire.STATE, summary(), 2, 9, 900))
    assert memory_rig.got("sensors/imu")
    (fast,), (slow,) = memory_rig.world.payloads("sensors/imu-fast"), memory_rig.world.payloads("sensors/imu")
    assert list(fast) == ["t", "seq", "mcu_ms", "value"]
    assert (fast["seq"], fast["mcu_ms"]) == (8, 800)
    assert 0 <= fast["t"] - began < 5000
    fast_value = {
        "accel_mps2": {"x": 9.807, "y": -0.02, "z": 0.003},
        "gyro_dps": {"x": 1.0, "y": -1.0, "z": 0.01},
        "temp_c": 25.12,
        "orientation_deg": {"roll": 0.33, "pitch": -0.07},
    }
    assert fast["value"] == fast_value
    assert slow["value"] == {
        **fast_value,
        "accel_norm_g": 1.001,
        "gyro_bias_dps": {"x": 0.05, "y": -0.06, "z": 0.07},
        "health": {
            "device": str(memory_rig.folder / "one"),
            "protocol": "pebble_serial_v1",
            "instance": "one",
            "samples_ok": 1000,
            "samples_error": 2,
            "calibration_samples": 200,
        },
    }
    generic = memory_rig.world.payloads("mcu/goob-imu-nano/imu_fast")[0]
    assert list(generic) == ["t", "seq", "mcu_ms", "device_uid", "interface", "profile", "value"]
    assert (generic["device_uid"], generic["interface"], generic["profile"]) == (
        "goob-imu-nano", "imu_fast", "imu.motion.v1",
    )  # fmt: skip
    assert generic["value"]["ax"] == 9.807


def test_qos_and_retain_follow_the_interface(rig: SerialRig) -> None:
    mcu, _ = rig.up(LAMP)
    assert rig.world.received[0].topic == f"{rig.base}/outgoing/mcu/lamp-1/local-only"
    mcu.send(wire.frame(wire.STATE, b"\x0b", 2), wire.frame(wire.STATE, b"\1", 3), wire.frame(wire.SAMPLE, bytes(4), 4))
    assert rig.got("mcu/lamp-1/glow")
    assert rig.values("lights/lamp") == [{"level": 5.5}]
    late = rig.listener("late")
    assert until(lambda: len(late.received) >= 4)
    time.sleep(0.2)
    assert sorted(m.topic.removeprefix(f"{rig.base}/outgoing/") for m in late.received) == [
        "lights/lamp", "mcu/lamp-1/describe", "mcu/lamp-1/lamp", "mcu/lamp-1/local-only",
    ]  # fmt: skip
    assert {int(m.qos) for m in rig.world.on("mcu/lamp-1/button") + rig.world.on("lights/lamp")} == {1}
    assert {int(m.qos) for m in rig.world.on("mcu/lamp-1/glow")} == {0}


def test_a_state_that_is_sent_only_once_is_not_lost(rig: SerialRig) -> None:
    """A state right after the manifest arrives before the alias is known to be free."""
    mcu = rig.mcu(LAMP, plugged=False)
    mcu.after_describing = wire.frame(wire.STATE, b"\x0a", 2) + wire.frame(wire.STATE, b"\x0b", 2)
    rig.bridge()
    mcu.plug()
    assert rig.got("lights/lamp")
    assert rig.values("mcu/lamp-1/lamp") == [{"level": 5.0}, {"level": 5.5}]
    assert rig.values("lights/lamp") == [{"level": 5.5}]


# -- commands


def test_a_command_reaches_the_mcu_and_a_retained_one_is_refused(rig: SerialRig) -> None:
    mcu, retained = rig.mcu(LAMP), {"level": 1, "on": False}
    for metric in ("mcu/lamp-1/lamp", "lights/lamp"):
        rig.world.command(metric, retained, retain=True)
    running = rig.bridge()
    rig.described("lamp-1")
    assert until(lambda: running.service.counters["stale"] == 2)
    rig.world.command("mcu/lamp-1/lamp", {"level": 40, "on": True})
    rig.world.command("lights/lamp", {"value": {"level": 40, "on": True}})
    assert mcu.obeyed(2) == [(1, b"\x50\x01")] * 2
    for command in mcu.commands():
        assert command.timestamp == pytest.approx(time.time() * 1000 % 2**32, abs=5000)


def test_what_does_not_fit_never_reaches_the_mcu(memory_rig: SerialRig, caplog: pytest.LogCaptureFixture) -> None:
    """Answers of the board are logged, too."""
    mcu, running = memory_rig.up(LAMP)
    caplog.set_level(logging.DEBUG)
    bad = [{"level": 10}, {"level": 200, "on": True}, {"level": 1, "on": 1}, [], None, b"\xff", b"[" * 40_000]
    for body in bad:
        memory_rig.world.command("mcu/lamp-1/lamp", body)
    memory_rig.world.command("mcu/lamp-1/lamp", {"level": 0, "on": False})
    assert mcu.obeyed() == [(1, b"\0\0")]
    assert running.service.counters["refused"] == len(bad)
    assert "lamp: on is missing" in caplog.text
    assert until(lambda: "lamp: command 2 accepted" in caplog.text)
    mcu.answers = lambda received: wire.frame(wire.NACK, b"busy", received.interface, received.sequence)
    memory_rig.world.command("mcu/lamp-1/lamp", {"level": 0, "on": False})
    assert until(lambda: "lamp: the MCU refuses command 3: busy" in caplog.text)


GOOD: dict[str, Any] = {"mcu/hs105-sta/o1_set": {"on": True}, "mcu/hs105-sta/o2_set": {"on": False}}


@pytest.mark.parametrize(
    ("group", "obeyed"),
    [
        ({"drive-values": {"z": 0.5}, **GOOD, "mcu/another/arm": {"angle": 3}}, [(1, b"\1"), (3, b"\0")]),
        (GOOD | {"mcu/hs105-sta/o2_set": {"on": 1}}, []),
        (GOOD | {"mcu/hs105-sta/o9_set": {"on": True}}, []),
        (GOOD | {"estop": {}}, []),
    ],
)
def test_of_a_group_a_board_gets_all_its_commands_in_a_write_or_none(
    memory_rig: SerialRig, group: dict[str, Any], obeyed: list[tuple[int, bytes]]
) -> None:
    mcu, running = memory_rig.up(STATION, groups=True)
    written: list[bytes] = []
    send = running.service.line.send  # type: ignore[attr-defined]
    running.service.line.send = lambda kind, data: written.append(data) or send(kind, data)  # type: ignore[attr-defined]
    memory_rig.world.command("group", group)
    for metric, command in group.items():
        memory_rig.world.command(metric, command | {"group": True})
    memory_rig.world.command("mcu/hs105-sta/o4_set", {"on": True})
    assert mcu.obeyed(len(obeyed) + 1) == [*obeyed, (7, b"\1")]
    assert len(written) == 1 + bool(obeyed)


# -- plugging in and out, restarts and new firmware


@pytest.mark.alone
def test_an_unplugged_device_is_cleared_and_a_replugged_one_is_requested_again(rig: SerialRig) -> None:
    mcu = rig.mcu(LAMP, sends_hello=False)
    running = rig.bridge()
    rig.described("lamp-1")
    assert rig.claimed()
    mcu.send(wire.frame(wire.STATE, b"\x0b", 2))
    assert rig.got("lights/lamp")
    mcu.unplug()
    assert rig.cleared("mcu/lamp-1/describe", "mcu/lamp-1/lamp", "lights/lamp")
    late = rig.listener("late")
    time.sleep(0.3)
    assert late.received == []
    rig.world.command("mcu/lamp-1/lamp", {"level": 40, "on": True})
    assert until(lambda: running.service.counters["no_device"] == 1)
    asked = mcu.asked()
    mcu.plug()
    rig.described("lamp-1")
    assert rig.world.at[-1] - mcu.plugged_at < 2
    assert mcu.asked() > asked
    assert rig.claimed()
    rig.world.command("lights/lamp", {"level": 40, "on": True})
    assert len(mcu.obeyed()) == 1, "the command sent while it was unplugged was dropped"


def test_a_partial_frame_of_an_earlier_host_does_not_damage_the_first_command(
    memory_rig: SerialRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    mcu, running = memory_rig.up(LAMP)
    mcu.unplug()
    assert memory_rig.cleared("mcu/lamp-1/describe")
    monkeypatch.setattr(host, "ASK_AFTER_OPENING_S", 60.0)  # the command is the first frame after opening
    mcu.half = wire.frame(wire.CMD, b"\x50\x01", 1, 7)[:9]
    mcu.plug()
    memory_rig.described("lamp-1")
    asked = mcu.asked()
    memory_rig.world.command("mcu/lamp-1/lamp", {"level": 40, "on": True})
    assert mcu.obeyed()
    assert mcu.asked() == asked
    assert running.service.counters["unanswered"] == 0


def test_new_firmware_while_it_runs(rig: SerialRig) -> None:
    mcu, _ = rig.up(LAMP)
    mcu.send(wire.frame(wire.STATE, b"\x0b", 2))
    assert rig.got("lights/lamp")
    renumbered = tuple(I(**{**vars(one), "id": one.id + 10, "channel": ""}) for one in LAMP.interfaces)
    mcu.manifest = LAMP.but(interfaces=renumbered, hash="h2")
    mcu.send(wire.frame(wire.HELLO, mcu.manifest.hello()))
    assert until(lambda: [body["schema_hash"] for body in rig.world.payloads("mcu/lamp-1/describe")] == ["h1", "h2"])
    assert rig.cleared("lights/lamp")
    assert rig.claimed()
    rig.world.command("lights/lamp", {"level": 40, "on": True})
    rig.world.command("mcu/lamp-1/lamp", {"level": 1, "on": True})
    assert [interface for interface, _ in mcu.obeyed()] == [11]
    mcu.send(wire.frame(wire.STATE, b"\x0c", 2), wire.frame(wire.STATE, b"\x0d", 12))
    assert until(lambda: len(rig.world.payloads("mcu/lamp-1/lamp")) == 2)
    assert rig.world.payloads("mcu/lamp-1/lamp")[-1]["value"] == {"level": 6.5}


def test_a_stale_manifest_of_a_killed_bridge_is_cleared_by_the_next(
    rig: SerialRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device was removed while no bridge was running."""
    monkeypatch.setattr(peers, "CONFIRM_S", 1.5)
    left = rig.network.client("killed").open(WAIT_S)
    manifest = b'{"protocol":"pebble_serial_v1","schema_version":1,"interface_count":0,"schema_hash":"h",' \
               b'"device_uid":"ghost","firmware_version":"1","model":"m","interfaces":[]}'  # fmt: skip
    left.publish(f"{rig.base}/outgoing/mcu/ghost/describe", manifest, qos=1, retain=True)  # type: ignore[arg-type]
    rig.described("ghost")
    left.close()
    rig.mcu(LAMP)
    rig.bridge()
    rig.described("lamp-1")
    assert rig.world.newest_raw("mcu/ghost/describe")
    assert rig.cleared("mcu/ghost/describe")
    assert rig.world.newest_raw("mcu/lamp-1/describe")


# -- health


@pytest.mark.parametrize("protocol", ["pebble_serial_v1", "imu_mpu6050_v1"])
def test_noise_is_not_heard_from_a_board(memory_rig: SerialRig, monkeypatch: pytest.MonkeyPatch, protocol: str) -> None:
    seen: list[tuple[Any, ...]] = []
    monkeypatch.setattr(Notifier, "mcu", lambda _notifier, *state: seen.append(state) or True)
    mcu = memory_rig.mcu(LAMP, sends_hello=False)
    mcu.silent = True
    memory_rig.bridge(protocol=protocol)
    noise = b"\xff\x00\x80\n>>> \nT a0=\n\0"
    assert until(lambda: mcu.send(noise) or any("is not understood" in why for _, _, why, _ in seen), step=0.1)
    assert {silent_ms for _, silent_ms, _, _ in seen} == {None}


@pytest.mark.alone
def test_a_silent_inertial_sensor_ends_the_process(memory_rig: SerialRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imu, "TIMEOUT_S", 0.6)
    mcu = memory_rig.mcu(IMU)
    running = memory_rig.bridge(log_level="INFO")
    mcu.stream(100, motion())
    assert memory_rig.got("sensors/imu-fast")
    time.sleep(0.8)
    assert running.alive
    mcu.silent = True
    stopped = time.monotonic()
    assert until(lambda: not running.alive)
    assert time.monotonic() - stopped > 0.5
    assert str(running.error) == "no sample for 0.6 s"
    assert memory_rig.cleared("mcu/goob-imu-nano/describe")


def test_a_refused_alias_is_logged_and_its_interface_still_works(
    memory_rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    """And where groups are off, a copy of a group's member is a command."""
    rogue = M("rogue", (
        I(1, "drive", wire.IN, wire.KIND_COMMAND, (F("x", wire.I8),), "drive-values"),
        I(2, "reboot", wire.OUT, wire.KIND_STATE, (F("v", wire.U8),), "online", "", wire.RETAIN),
    ))  # fmt: skip
    mcu, _ = memory_rig.up(rogue)
    mcu.send(wire.frame(wire.STATE, b"\1", 2))
    assert memory_rig.got("mcu/rogue/reboot")
    memory_rig.world.command("group", {"mcu/rogue/drive": {"x": 7}})
    memory_rig.world.command("drive-values", {"x": 1, "z": 0})
    memory_rig.world.command("mcu/rogue/drive", {"x": 5, "group": True})
    assert mcu.obeyed() == [(1, b"\5")]
    assert memory_rig.world.on("online") == []
    assert "rogue: no alias for drive: incoming/drive-values: the channel is the robot's own" in caplog.text


def test_samples_and_summaries_of_text_are_published_bad_lines_logged_and_nothing_is_ever_sent(
    memory_rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    mcu = memory_rig.mcu(M("unused"))  # its protocol is text, so it is never asked for a manifest
    running = memory_rig.bridge(protocol="imu_mpu6050_v1")

    def received() -> object:
        mcu.pour(b"I n=1\n" + b"x" * 5000 + b"\n" + SLOW + b"\n" + FAST + b"\r\n" + SLOW + b"\n")
        time.sleep(0.05)
        logged = [(record.getMessage(), record.levelno) for record in caplog.records]
        return memory_rig.world.payloads("sensors/imu") and ("MCU: I n=1", logging.WARNING) in logged

    assert until(received)  # what is sent while the port is being opened may be cut short
    assert running.service.counters["lines_discarded"] >= 1
    fast, slow = memory_rig.world.payloads("sensors/imu-fast")[0], memory_rig.world.payloads("sensors/imu")[0]
    assert (fast["seq"], fast["mcu_ms"], fast["value"]["orientation_deg"]) == (17, 1234, {"roll": 1.5, "pitch": -3.25})
    assert slow["value"]["accel_mps2"] == fast["value"]["accel_mps2"] == {"x": 0.123, "y": -0.5, "z": 9.807}
    assert (slow["value"]["health"]["protocol"], slow["value"]["health"]["samples_ok"]) == ("imu_mpu6050_v1", 1000)
    qos = {message.topic.rpartition("/")[2]: int(message.qos) for message in memory_rig.world.received}
    assert qos == {"imu-fast": 0, "imu": 1}
    running.stop()
    assert (mcu.received, mcu.rest) == ([], b"")


def test_a_terminated_process_withdraws_its_device(local: Broker, tmp_path: Path) -> None:
    mcu = ScriptedMcu(tmp_path / "port", STATION, sends_hello=True)
    line = {"enabled": True, "protocol": "pebble_serial_v1", "serial": {"port": str(mcu.link)}}
    with mcu, ProgramRobot("mqtt", local.port, {"serial_mcu_bridge": {"instances": {"sockets": line}}}) as robot:
        process = robot.run(SERIAL_PROTOCOLS["pebble_serial_v1"].service, "sockets")
        robot.world.described("hs105-sta")
        mcu.send(wire.frame(wire.STATE, b"\1\1\0", 2))
        assert robot.world.got("outlets/o1/status")
        robot.world.command("outlets/o1/power", {"on": True})
        assert until(mcu.commands)
        assert process.end() == 0
        assert robot.world.cleared("mcu/hs105-sta/describe", "outlets/o1/status", "mcu/hs105-sta/o1_state")
