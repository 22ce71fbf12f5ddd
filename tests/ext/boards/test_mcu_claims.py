"""Claims of channels by self-describing devices, peers, and what is local_only; then at serial lines."""

from __future__ import annotations

import json
import logging
import re
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pebble.config import SerialBridge, parse
from pebble.contract import DRIVE, MCU_DESCRIBE, codec
from pebble.contract.payloads import McuManifest
from pebble.extension import ours
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.runtime.addresses import Addresses
from pebble.services.serial_mcu_bridge.devices.aliases import claims
from pebble.services.serial_mcu_bridge.devices.device import Device
from pebble.services.serial_mcu_bridge.devices.peers import CONFIRM_S, PeerDevices
from pebble.services.serial_mcu_bridge.devices.private_topics import LocalOnly
from pebble.services.serial_mcu_bridge.imu.reports import ImuReports, ImuWatchdog
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame, manifest
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.transports import Message, QoS
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, LAMP, STATION, F, I, M
from tests.kit.board import SerialRig, motion
from tests.kit.robot import BASE, ROBOT
from tests.support import ROOT, cases, until

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
    nameless = msgspec.structs.replace(published(STATION), interfaces=[{"channel": ""}, {"channel": 5}])
    assert claims(nameless).granted == {}


COMMANDS = [
    "drive-values", "soundboard-command", "flags/anything", "flags", "mcu/other/led", "mcu", "estop", "estop-reset",
    "estop/mcu", "estop-anything", "by/anna/drive-values", "control",
]  # fmt: skip
PUBLISHED = [
    "online", "heartbeat", "status", "front-camera", "wheel-odometry", "flags/mqtt-video", "mcu/other/describe",
    "bridge-probe", "estop/mcu", "estop/mcu/more", "by/anna", "control/lease",
]  # fmt: skip


def test_which_channels_are_refused_with_which_reason() -> None:
    reasons = [refused(command("a", one)) for one in COMMANDS] + [refused(state("a", one)) for one in PUBLISHED]
    renamed = claims(published(M("u", (command("a", "elsewhere"),))), {"incoming/elsewhere": DRIVE}.get)
    assert [reason for reason in (*reasons, renamed.refused["a"]) if "robot's own" not in reason] == []
    for profile in ("", "imu.motion.v1", "imu.summary.v1"):
        assert "it needs the profile imu." in refused(state("a", "sensors/imu", profile=profile))
    topics = {"drive_values": f"{BASE}/incoming/elsewhere", "high_rate": f"{BASE}/outgoing/motion"}
    raw = {"robot": {"id": ROBOT}, "services": {"serial_mcu_bridge": {"topics": topics}}}
    config = parse(raw, folder=Path("/"), env={})
    wheels = M("u", (command("a", "elsewhere"), command("b", "drive-values", 2))).describe()
    device = Device(parse_describe(wheels), Addresses(config), ImuReports(SerialBridge(), ""))
    assert device.claims.refused.keys() == {"a", "b"}, "both the topic of the config and that of the contract"
    sensor = Device(parse_describe(IMU.describe()), Addresses(config), ImuReports(SerialBridge(), ""))
    assert sensor.claims.granted.keys() == {"outgoing/motion", "outgoing/sensors/imu"}, "that of the config"


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


@settings(max_examples=cases(40, 1000))
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
    ("protocol", "instance", "expected"),
    [("imu_mpu6050_v1", "", 5.0), ("pebble_serial_v1", "imu", 5.0), ("pebble_serial_v1", "outlets", 0.0)],
)
def test_which_lines_have_a_timeout(protocol: str, instance: str, expected: float) -> None:
    """The first sample may take longer."""
    ours()  # which protocols there are
    watchdog = ImuWatchdog(SerialBridge(protocol=protocol), instance)
    assert watchdog.timeout_s == expected
    watchdog.begin(100.0)
    assert [watchdog.expired(at) for at in (106.9, 107.1)] == [False, expected > 0]
    watchdog.sample(108.0)
    assert [watchdog.expired(at) for at in (112.9, 113.1)] == [False, expected > 0]
    watchdog.end()
    assert not watchdog.expired(1000.0)


OUT = f"{BASE}/outgoing"
PRIVATE = ("mcu/spy-1/fast", "lab/fast", "mcu/spy-1/secret", "lab/secret", "mcu/spy-1/imu_fast", "lab/imu-fast")


DESCRIBE, LIST = "mcu/spy-1/describe", "mcu/spy-1/local-only"


def local_only(*topics: str, uid: str = "spy-1") -> Message:
    payload = json.dumps({"topics": topics}).encode()
    return Message(f"{OUT}/mcu/{uid}/local-only", payload, retain_requested=True)


def sample(interface: str, uid: str = "spy-1") -> bytes:
    body = {"t": 1, "seq": 1, "mcu_ms": 1, "device_uid": uid, "interface": interface, "profile": "", "value": {"v": 1}}
    return json.dumps(body).encode()


def value(metric: str, interface: str = "", **more: Any) -> Message:
    """A value of the interface that the topic ends with, unless another is named."""
    return Message(f"{OUT}/{metric}", sample(interface or metric.rpartition("/")[2]), **more)


def cleared(metric: str) -> Message:
    return Message(f"{OUT}/{metric}", b"", retain_requested=True)


FAST, SLOW = ("mcu/spy-1/fast", "lab/fast"), ("mcu/spy-1/slow", "lab/slow")
KNOWN = local_only(*(f"outgoing/{metric}" for metric in PRIVATE))
NONSENSE = (b"", b"{", b'{"device_uid": 5, "interface": "a"}', b'["device_uid"]', b"\xff\xfe", sample("slow"))
#: What is offered one after the other, and what passes then: the message, nothing, or the topics that are named.
HISTORIES: dict[str, list[tuple[Message, bool | list[str]]]] = {
    "what is listed stays, and what is not passes": [
        (KNOWN, False),
        *((value(metric), False) for metric in PRIVATE),
        *((value(metric), True) for metric in SLOW),
    ],
    "before the list nothing of the MCU passes but its manifest": [
        *((value(metric), False) for metric in (*FAST, *SLOW)),
        (value("anywhere/else", "fast"), False),
        (Message(f"{OUT}/{DESCRIBE}", b"{}", retain_requested=True), True),
        (KNOWN, False),
        *((value(metric), False) for metric in FAST),
        *((value(metric), True) for metric in SLOW),
    ],
    # Retained messages arrive in any order, and later subscribers need the state of a socket.
    **{
        f"a value with {flag} waits for the list": [
            *((value(metric, **{flag: True}), False) for metric in (*SLOW, "lab/secret")),
            (KNOWN, [*SLOW]),
            (KNOWN, False),
        ]
        for flag in ("retain", "retain_requested")
    },
    "a retained value that was cleared is not forwarded later": [
        *(step for one in SLOW for step in ((value(one, retain=True), False), (cleared(one), True))),
        (KNOWN, False),
    ],
    "a board that restarts: nothing passes until it is described again, and its states are cleared": [
        (KNOWN, False),
        (cleared(LIST), False),
        (cleared("mcu/spy-1/slow"), True),
        (cleared("mcu/spy-1/secret"), False),
        *((value(metric), False) for metric in (*FAST, *SLOW)),
        (KNOWN, False),
        *((value(metric), True) for metric in SLOW),
    ],
    "two boards with one alias: the list of each counts, and neither speaks for the other": [
        (local_only(), False),
        (value("lab/slow", retain=True), True),
        (Message(f"{OUT}/lab/slow", sample("slow", "spy-2"), retain=True), False),
        (local_only("outgoing/lab/slow", uid="spy-2"), False),
        (value("lab/slow"), False),
        (value("mcu/spy-1/slow"), True),
    ],
    "a list that cannot be read lets nothing pass, of this MCU": [
        *((KNOWN, False), (local_only(uid="spy-2"), False)),
        (Message(f"{OUT}/{LIST}", b'{"topics": 5}', retain_requested=True), False),
        *((value("lab/slow"), False), (value("mcu/spy-2/slow"), True)),
    ],
    "a list keeps no stop and no control of the robot back": [
        (local_only("outgoing/estop-state/goob", "outgoing/control/goob"), False),
        *((Message(f"{OUT}/{metric}", b"{}"), True) for metric in ("estop-state/goob", "control/goob")),
    ],
    "nonsense is neither an error nor held back": [
        (KNOWN, False),
        *((Message(f"{OUT}/strange", payload), True) for payload in NONSENSE),
        (value("lab/slow"), True),
    ],
}


@pytest.mark.parametrize("history", HISTORIES.values(), ids=HISTORIES)
def test_what_passes(history: list[tuple[Message, bool | list[str]]]) -> None:
    topics = LocalOnly(BASE)
    for message, passes in history:
        expected = [message.topic.removeprefix(f"{OUT}/")] if passes is True else passes or []
        assert [admitted.topic.removeprefix(f"{OUT}/") for admitted in topics.admit(message)] == expected, message


def test_which_commands_stay() -> None:
    """Requests for a manifest do not leave the robot, nor commands to an MCU without a list."""
    topics = LocalOnly(BASE)
    incoming = [f"{BASE}/incoming/{metric}" for metric in ("mcu/spy-1/describe", "mcu/spy-1/tune", "mcu/spy-1/set")]
    aliases = [f"{BASE}/incoming/{metric}" for metric in ("lab/tune", "lab/set", "estop", "drive-values")]
    assert [topics.stays(topic) for topic in (*incoming, *aliases)] == [True] * 3 + [False] * 4
    topics.admit(local_only("incoming/mcu/spy-1/tune", "incoming/lab/tune", "incoming/estop"))
    assert [topics.stays(topic) for topic in (*incoming, *aliases)] == [True, True, False, True, False, False, False]


def test_memory_is_bounded() -> None:
    topics = LocalOnly(BASE)
    for number in range(300):
        assert topics.admit(value(f"lab/slow-{number}", "slow", retain=True)) == []
    assert len(topics.admit(KNOWN)) == 256, "waiting values"
    for number in range(300):
        topics.admit(local_only(uid=f"spy-{number}"))
    slow = [Message(f"{OUT}/mcu/spy-{number}/slow", b"{}") for number in range(300)]
    assert sum(len(topics.admit(message)) for message in slow) == 256, "MCUs"


def test_the_examples_are_a_valid_manifest_and_valid_frames() -> None:
    text = "".join((ROOT / "docs/ext" / name).read_text() for name in ("boards.md", "serial-protocol.md"))
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert manifest.parse_hello(names["HELLO"]).device_uid == "lamp-1"
    described = manifest.parse_describe(names["DESCRIBE"])
    assert set(claims(described.payload()).granted) == {"incoming/lights/lamp", "outgoing/lights/lamp"}
    request, command = (bytes.fromhex(found) for found in re.findall(r"`((?:[0-9a-f]{2} ){9,}00)`", text))
    assert frame.decode(request[:-1]).type is frame.Type.DESCRIBE_REQ
    assert frame.decode(command[:-1]) == frame.Frame(frame.Type.CMD, b"\x01", 3, 1)


# -- two devices with one channel: neither gets it; two with one uid: a warning; our own firmware behind a pty


def test_a_channel_that_two_claim_is_unused_until_one_leaves(rig: SerialRig, caplog: pytest.LogCaptureFixture) -> None:
    one, two = rig.mcu(IMU.but(uid="imu-1"), "one"), rig.mcu(IMU.but(uid="imu-2"), "two", plugged=False)
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
    assert until(lambda: 2.0 in {body["value"]["accel_mps2"]["x"] for body in rig.world.payloads("sensors/imu-fast")})
    assert "imu-2: outgoing/sensors/imu-fast is in use again" in caplog.text


def test_of_two_that_claim_one_channel_that_of_the_config_has_it(
    memory_rig: SerialRig, caplog: pytest.LogCaptureFixture
) -> None:
    one, two = memory_rig.mcu(IMU.but(uid="imu-1"), "one"), memory_rig.mcu(IMU.but(uid="imu-2"), "two", plugged=False)
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

    def obeys() -> list[frame.Frame]:
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


@pytest.mark.alone
def test_found_within_seconds_when_plugged_in_again_and_every_sample_arrives(tmp_path: Path) -> None:
    uid = "goob-imu"
    with closing(SerialRig("zenoh", tmp_path)) as rig, PtyMcu("goob_imu", rig.folder / "imu") as board:
        running = rig.bridge("imu")
        rig.described(uid)
        board.unplug()
        assert rig.cleared(f"mcu/{uid}/describe")
        count, plugged = len(rig.world.on("sensors/imu-fast")), time.monotonic()
        board.replug()
        assert until(lambda: len(rig.world.on("sensors/imu-fast")) > count)
        first = rig.world.on("sensors/imu-fast")[count]
        assert rig.world.at[rig.world.received.index(first)] - plugged < 3.0, "two on an idle machine"
        rig.described(uid)
        assert until(lambda: len(rig.world.on("sensors/imu-fast")) >= count + 96 * cases(1, 5))
        numbers = [body["seq"] for body in rig.world.payloads("sensors/imu-fast")[count:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert until(lambda: rig.world.on("sensors/imu"))
        fast, slow = rig.world.payloads("sensors/imu-fast")[-1], rig.world.payloads("sensors/imu")[-1]
        assert fast["value"]["accel_mps2"]["z"] == pytest.approx(9.8, abs=0.5), "the board lies flat"
        assert slow["value"]["accel_norm_g"] == pytest.approx(1.0, abs=0.05)
        assert slow["value"]["health"]["samples_error"] == 0
        assert running.alive
