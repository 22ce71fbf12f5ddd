"""Claims of channels by self-describing devices, and peers: without a serial line and without a clock."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pebble.config import SerialBridge
from pebble.contract import DRIVE, MCU_DESCRIBE, codec
from pebble.contract.payloads import McuManifest
from pebble.extension import ours
from pebble.services.serial_mcu_bridge.devices.aliases import claims
from pebble.services.serial_mcu_bridge.devices.peers import CONFIRM_S, PeerDevices
from pebble.services.serial_mcu_bridge.devices.private_topics import LocalOnly
from pebble.services.serial_mcu_bridge.imu.reports import ImuWatchdog
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.transports import Message
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, STATION, F, I, M
from tests.support import cases

# -- claims


def published(manifest: M) -> McuManifest:
    return parse_describe(manifest.describe()).payload()


def state(name: str, channel: str, number: int = 1, **more: object) -> I:
    fields = {"id": number, "name": name, "dir": wire.OUT, "kind": wire.KIND_STATE, "fields": (F("v", wire.U8),)}
    return I(**{**fields, "channel": channel, **more})  # type: ignore[arg-type]


def command(name: str, channel: str, number: int = 1) -> I:
    return I(number, name, wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), channel)


def granted(*interfaces: I) -> dict[str, str]:
    return dict(claims(published(M("u", interfaces))).granted)


def refused(interface: I) -> str:
    return claims(published(M("u", (interface,)))).refused["a"]


def test_which_channels_a_device_gets() -> None:
    assert granted(*IMU.interfaces) == {"outgoing/sensors/imu-fast": "imu_fast", "outgoing/sensors/imu": "imu"}
    station = claims(published(STATION))
    assert not station.refused
    assert station.granted["incoming/outlets/o3/power"] == "o3_set"
    assert station.granted["outgoing/outlets/o3/status"] == "o3_state"
    both = granted(state("a", "lamp/one"), command("b", "lamp/one", 2))
    assert both == {"outgoing/lamp/one": "a", "incoming/lamp/one": "b"}, "outside the contract it is free"
    twice = claims(published(M("u", (state("a", "lamp"), state("b", "lamp", 2)))))
    assert (twice.granted, twice.refused) == ({"outgoing/lamp": "a"}, {"b": "outgoing/lamp: a has it already"})


COMMANDS = [
    "drive-values", "lights-solid", "front-camera", "audio", "audio-stream", "soundboard-command", "autonomy-command",
    "flags/reboot", "flags/mqtt-video", "flags/anything", "flags", "mip-raw", "mcu/other/led", "mcu",
    "estop", "estop-reset", "estop/mcu", "estop-anything", "by", "by/anna/drive-values", "control",
]  # fmt: skip
PUBLISHED = [
    "online", "heartbeat", "capabilities", "status", "logs", "charging-status", "charging-level", "touch-sensors",
    "front-camera", "audio", "wheel-odometry", "flags/mqtt-video", "mcu/other/describe", "bridge-probe",
    "estop", "estop/mcu", "estop/mcu/more", "estop-reset", "by/anna", "control", "control/lease",
]  # fmt: skip


def test_which_channels_are_refused_with_which_reason() -> None:
    reasons = [refused(command("a", one)) for one in COMMANDS] + [refused(state("a", one)) for one in PUBLISHED]
    renamed = claims(published(M("u", (command("a", "elsewhere"),))), {"incoming/elsewhere": DRIVE}.get)
    assert [reason for reason in (*reasons, renamed.refused["a"]) if "robot's own" not in reason] == []
    for channel in ("sensors/imu", "sensors/imu-fast"):
        for profile in ("", "imu.motion.v1", "imu.summary.v1"):
            assert "it needs the profile imu." in refused(state("a", channel, profile=profile))


def test_a_local_only_interface_gets_no_public_channel_without_a_device_uid() -> None:
    """The bridge identifies local_only values by `device_uid`, which the body of sensors/imu does not have."""
    hidden = IMU.but(interfaces=tuple(I(**{**vars(one), "flags": wire.LOCAL_ONLY}) for one in IMU.interfaces))
    found = claims(published(hidden))
    assert found.granted == {"outgoing/sensors/imu-fast": "imu_fast"}
    assert "it may leave the robot" in found.refused["imu"]


_ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats(allow_nan=False) | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)
_ODD_FIELDS = _ANYTHING | st.lists(st.fixed_dictionaries({"name": _ANYTHING}) | _ANYTHING, max_size=3)
_ODD_INTERFACE = st.fixed_dictionaries({}, optional={
    "name": _ANYTHING | st.just("a"),
    "dir": _ANYTHING | st.sampled_from(["in", "out"]),
    "channel": _ANYTHING | st.sampled_from(["sensors/imu", "sensors/imu-fast", "outlets/o1/status", "a//", "flags"]),
    "profile": _ANYTHING | st.sampled_from(["imu.motion.v1", "imu.summary.v1"]),
    "local_only": _ANYTHING,
    "encoding": _ANYTHING | st.fixed_dictionaries({"fields": _ODD_FIELDS}),
})  # fmt: skip


@settings(max_examples=cases(100, 1000))
@given(st.lists(_ODD_INTERFACE, max_size=4))
@example([{"channel": "sensors/imu", "profile": "imu.summary.v1", "encoding": {"fields": 5}}])
def test_no_manifest_of_another_device_raises_anything(interfaces: list[dict[str, object]]) -> None:
    body = {"protocol": "pebble_serial_v1", "schema_version": 1, "interface_count": 1, "schema_hash": "",
            "device_uid": "u", "firmware_version": "", "model": "", "interfaces": interfaces}  # fmt: skip
    raw = msgspec.json.encode(body)
    claims(codec.decode(MCU_DESCRIBE, raw))
    topics = LocalOnly("pebble/robots/rover")
    topics.admit(Message(MCU_DESCRIBE.topic("pebble/robots/rover", uid="u"), raw, retain_requested=True))
    topics.admit(Message("pebble/robots/rover/outgoing/sensors/imu", b'{"device_uid": "u"}'))


# -- peer devices


def test_a_peer_device_claims_until_it_is_withdrawn_or_a_retained_manifest_is_not_confirmed() -> None:
    peers = PeerDevices()
    peers.add("b", frozenset({"outgoing/x", "outgoing/y"}), 0.0, retained=False)
    assert peers.due is None
    for name in ("ghost", "alive"):
        peers.add(name, frozenset({"outgoing/x"}), 10.0, retained=True)
    assert peers.due == 10.0 + CONFIRM_S
    peers.add("alive", frozenset({"outgoing/x"}), 10.1, retained=False)
    assert peers.left_over(10.0 + CONFIRM_S - 0.01) == []
    assert (peers.claimants("outgoing/x"), peers.claimants("outgoing/y")) == (["alive", "b", "ghost"], ["b"])
    peers.forget("b")
    assert peers.left_over(10.0 + CONFIRM_S) == ["ghost"]
    assert (peers.claimants("outgoing/x"), peers.claimants("outgoing/y")) == (["alive"], [])
    assert peers.due is None
    for number in range(1000):
        peers.add(f"u{number}", frozenset({"outgoing/x"}), 0.0, retained=False)
    assert len(peers.claimants("outgoing/x")) == 256


# -- the watchdog of inertial sensors


@pytest.mark.parametrize(
    ("section", "instance", "expected"),
    [
        ({"protocol": "imu_mpu6050_v1"}, "", 5.0),
        ({"protocol": "pebble_serial_v1"}, "imu", 5.0),
        ({"protocol": "pebble_serial_v1"}, "outlets", 0.0),
    ],
)
def test_which_lines_have_a_timeout(section: dict[str, object], instance: str, expected: float) -> None:
    """The first sample may take longer."""
    ours()  # which protocols there are
    watchdog = ImuWatchdog(SerialBridge(**section), instance)  # type: ignore[arg-type]
    assert watchdog.timeout_s == expected
    watchdog.begin(100.0)
    assert [watchdog.expired(at) for at in (106.9, 107.1)] == [False, expected > 0]
    watchdog.sample(108.0)
    assert [watchdog.expired(at) for at in (112.9, 113.1)] == [False, expected > 0]
    watchdog.end()
    assert not watchdog.expired(1000.0)
