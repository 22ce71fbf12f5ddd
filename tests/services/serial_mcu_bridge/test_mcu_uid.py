"""Two devices with one uid, and their claims of channels: without a serial line and without a clock."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pebble.config import SerialBridge
from pebble.contract import MCU_DESCRIBE, codec
from pebble.contract.payloads import McuManifest
from pebble.services.mqtt_bridge.private_topics import PrivateTopics
from pebble.services.serial_mcu_bridge.devices.aliases import claims
from pebble.services.serial_mcu_bridge.devices.imu import ImuWatchdog
from pebble.services.serial_mcu_bridge.devices.peers import CONFIRM_S, PeerDevices
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.services.serial_mcu_bridge.pebble_serial_v1.uid_claim import AGAIN_S, ASK_S, Move, UidClaim
from pebble.transports import Message
from tests.services.serial_mcu_bridge import mcu_wire as wire
from tests.services.serial_mcu_bridge.mcu_wire import IMU, STATION, F, I, M
from tests.support import cases

# -- uids


def test_a_uid_without_an_objection_is_acquired() -> None:
    claim = UidClaim("a")
    assert claim.request("u", 0.0) is Move.ASK
    assert claim.tick(ASK_S - 0.01) is Move.NOTHING
    assert claim.tick(ASK_S) is Move.HOLD
    assert claim.due is None
    assert claim.on_question("u", "b", 1.0) is Move.ANSWER
    assert claim.on_question("other", "b", 1.0) is Move.NOTHING
    assert claim.on_question("u", "a", 1.0) is Move.NOTHING, "its own question, echoed"
    assert claim.on_manifest("u", 1.0) is Move.INSIST, "its own manifest, echoed, or that of another holder"


def test_of_two_holders_the_one_with_the_smaller_token_yields() -> None:
    weak, strong = UidClaim("a"), UidClaim("b")
    for claim in (weak, strong):
        claim.request("u", 0.0)
        assert claim.tick(ASK_S) is Move.HOLD
    assert strong.on_question("u", "a", 1.0, has=True) is Move.INSIST
    assert weak.on_question("u", "b", 1.0, has=True) is Move.YIELD
    assert weak.due == 1.0 + AGAIN_S


def test_a_requester_yields_to_a_holder_whatever_the_tokens() -> None:
    claim = UidClaim("z")
    claim.request("u", 0.0)
    assert claim.on_question("u", "a", 0.1, has=True) is Move.YIELD


def test_a_requester_that_is_answered_waits_and_asks_again() -> None:
    claim = UidClaim("z")
    claim.request("u", 0.0)
    assert claim.on_manifest("other", 0.1) is Move.NOTHING
    assert claim.on_manifest("u", 0.1) is Move.YIELD
    assert claim.due == 0.1 + AGAIN_S
    assert claim.on_question("u", "b", 1.0) is Move.NOTHING
    assert claim.tick(0.1 + AGAIN_S) is Move.ASK
    assert claim.on_manifest("u", 6.0) is Move.YIELD
    assert claim.on_withdrawal("u", 7.0) is Move.ASK
    assert claim.tick(7.0 + ASK_S) is Move.HOLD


def test_a_released_uid_is_not_answered_for() -> None:
    claim = UidClaim("a")
    claim.request("u", 0.0)
    claim.release()
    assert claim.tick(10.0) is Move.NOTHING
    assert claim.on_question("u", "b", 10.0) is Move.NOTHING


@dataclass
class LocalNetwork:
    """Claims that receive each other's messages, and their own, after ``delay`` s."""

    delay: float
    claims: dict[str, UidClaim] = field(default_factory=dict)
    on_its_way: list[tuple[float, str, str]] = field(default_factory=list)
    holders: set[str] = field(default_factory=set)

    def act(self, token: str, move: Move, now: float) -> None:
        if move in (Move.ASK, Move.ANSWER):
            self.on_its_way.append((now + self.delay, move.name, token))
        elif move is Move.HOLD:
            self.holders.add(token)
            self.on_its_way.append((now + self.delay, "ANSWER", token))

    def run(self, begin: dict[str, float], until: float) -> None:
        for step in range(int(until * 1000)):
            now = step / 1000
            due = [one for one in self.on_its_way if one[0] <= now]
            self.on_its_way = [one for one in self.on_its_way if one[0] > now]
            for token, at in begin.items():
                if step == round(at * 1000):
                    self.claims[token] = UidClaim(token)
                    self.act(token, self.claims[token].request("u", now), now)
            for _, what, sender in due:
                for token, claim in self.claims.items():
                    answer = claim.on_question("u", sender, now) if what == "ASK" else claim.on_manifest("u", now)
                    self.act(token, answer, now)
            for token, claim in self.claims.items():
                self.act(token, claim.tick(now), now)


@pytest.mark.parametrize("delay", [0.001, 0.02, 0.09])
@pytest.mark.parametrize("later", [0.0, 0.001, 0.05, 0.15, 0.3, 3.0])
@pytest.mark.parametrize("tokens", ["ab", "ba"])
def test_of_two_exactly_one_has_it(delay: float, later: float, tokens: str) -> None:
    network = LocalNetwork(delay)
    network.run({tokens[0]: 0.0, tokens[1]: later}, 12.0)
    assert len(network.holders) == 1


def test_of_five_at_once_exactly_one_has_it() -> None:
    network = LocalNetwork(0.01)
    network.run(dict.fromkeys("cadbe", 0.0), 12.0)
    assert network.holders == {"e"}


# -- claims


def published(manifest: M) -> McuManifest:
    return parse_describe(manifest.describe()).payload()


def state(name: str, channel: str, number: int = 1, **more: object) -> I:
    fields = {"id": number, "name": name, "dir": wire.OUT, "kind": wire.KIND_STATE, "fields": (F("v", wire.U8),)}
    return I(**{**fields, "channel": channel, **more})  # type: ignore[arg-type]


def command(name: str, channel: str, number: int = 1) -> I:
    return I(number, name, wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), channel)


def test_the_devices_of_the_original_pebble_get_all_their_channels() -> None:
    assert claims(published(IMU)).granted == {
        "outgoing/sensors/imu-fast": "imu_fast",
        "outgoing/sensors/imu": "imu",
    }
    station = claims(published(STATION))
    assert not station.refused
    assert station.granted["incoming/outlets/o3/power"] == "o3_set"
    assert station.granted["outgoing/outlets/o3/status"] == "o3_state"


def test_a_channel_outside_the_contract_is_free_in_both_directions() -> None:
    both = M("u", (state("a", "lamp/one"), command("b", "lamp/one", 2)))
    assert claims(published(both)).granted == {"outgoing/lamp/one": "a", "incoming/lamp/one": "b"}


def test_the_second_of_a_device_is_refused() -> None:
    twice = claims(published(M("u", (state("a", "lamp"), state("b", "lamp", 2)))))
    assert twice.granted == {"outgoing/lamp": "a"}
    assert twice.refused == {"b": "outgoing/lamp: a has it already"}


@pytest.mark.parametrize("channel", [
    "drive-values", "lights-solid", "front-camera", "audio", "audio-stream", "soundboard-command", "autonomy-command",
    "flags/reboot", "flags/mqtt-video", "flags/anything", "flags", "mip-raw", "mcu/other/led", "mcu",
    "estop", "estop-reset", "estop/mcu", "estop-anything", "by", "by/anna/drive-values", "control",
])  # fmt: skip
def test_channels_that_command_the_robot_are_refused(channel: str) -> None:
    assert "robot's own" in claims(published(M("u", (command("a", channel),)))).refused["a"]


@pytest.mark.parametrize("channel", [
    "online", "heartbeat", "capabilities", "status", "logs", "charging-status", "charging-level", "touch-sensors",
    "front-camera", "audio", "wheel-odometry", "flags/mqtt-video", "mcu/other/describe", "bridge-probe",
    "estop", "estop/mcu", "estop/mcu/more", "estop-reset", "by/anna", "control", "control/lease",
])  # fmt: skip
def test_channels_the_robot_publishes_are_refused(channel: str) -> None:
    assert "robot's own" in claims(published(M("u", (state("a", channel),)))).refused["a"]


@pytest.mark.parametrize("channel", ["sensors/imu", "sensors/imu-fast"])
def test_an_inertial_channel_needs_its_profile_and_fields(channel: str) -> None:
    for profile in ("", "imu.motion.v1", "imu.summary.v1"):
        refused = claims(published(M("u", (state("a", channel, profile=profile),)))).refused
        assert "it needs the profile imu." in refused["a"]


def test_a_local_only_interface_gets_no_public_channel_without_a_device_uid() -> None:
    """The bridge identifies local_only values by `device_uid`, which the body of sensors/imu does not have."""
    hidden = IMU.but(interfaces=tuple(I(**{**vars(one), "flags": wire.LOCAL_ONLY}) for one in IMU.interfaces))
    hidden_claims = claims(published(hidden))
    assert hidden_claims.granted == {"outgoing/sensors/imu-fast": "imu_fast"}
    assert "it may leave the robot" in hidden_claims.refused["imu"]


def test_a_channel_that_the_config_renames_is_the_robots_own_too() -> None:
    from pebble.contract import DRIVE

    taken = claims(published(M("u", (command("a", "elsewhere"),))), {"incoming/elsewhere": DRIVE}.get)
    assert "robot's own" in taken.refused["a"]


def test_malformed_manifests_of_other_devices_raise_nothing() -> None:
    odd = McuManifest(protocol="x", schema_version=1, interface_count=1, schema_hash="", device_uid="u",
                      firmware_version="", model="", interfaces=[
                          {}, {"channel": 5}, {"channel": "a", "encoding": 7}, {"channel": "sensors/imu",
                           "profile": "imu.summary.v1", "encoding": {"fields": [1, {}, None]}}])  # fmt: skip
    assert claims(odd).granted == {"outgoing/a": "None"}


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


@settings(max_examples=cases(200, 1000))
@given(st.lists(_ODD_INTERFACE, max_size=4))
@example([{"channel": "sensors/imu", "profile": "imu.summary.v1", "encoding": {"fields": 5}}])
def test_no_manifest_of_another_device_raises_anything(interfaces: list[dict[str, object]]) -> None:
    body = {"protocol": "pebble_serial_v1", "schema_version": 1, "interface_count": 1, "schema_hash": "",
            "device_uid": "u", "firmware_version": "", "model": "", "interfaces": interfaces}  # fmt: skip
    raw = msgspec.json.encode(body)
    claims(codec.decode(MCU_DESCRIBE, raw))
    topics = PrivateTopics("pebble/robots/rover")
    topics.admit(Message(MCU_DESCRIBE.topic("pebble/robots/rover", uid="u"), raw, retain_requested=True))
    topics.admit(Message("pebble/robots/rover/outgoing/sensors/imu", b'{"device_uid": "u"}'))


# -- peer devices


def test_a_peer_device_claims_until_it_is_withdrawn() -> None:
    peers = PeerDevices()
    peers.add("b", frozenset({"outgoing/x", "outgoing/y"}), 0.0, retained=False)
    peers.add("a", frozenset({"outgoing/x"}), 0.0, retained=False)
    assert peers.claimants("outgoing/x") == ["a", "b"]
    assert peers.claimants("outgoing/y") == ["b"]
    assert peers.due is None
    peers.forget("b")
    assert peers.claimants("outgoing/y") == []


def test_a_retained_manifest_counts_until_its_confirmation_times_out() -> None:
    peers = PeerDevices()
    peers.add("ghost", frozenset({"outgoing/x"}), 10.0, retained=True)
    peers.add("alive", frozenset({"outgoing/x"}), 10.0, retained=True)
    assert peers.due == 10.0 + CONFIRM_S
    peers.add("alive", frozenset({"outgoing/x"}), 10.1, retained=False)
    assert peers.left_over(10.0 + CONFIRM_S - 0.01) == []
    assert peers.claimants("outgoing/x") == ["alive", "ghost"]
    assert peers.left_over(10.0 + CONFIRM_S) == ["ghost"]
    assert peers.claimants("outgoing/x") == ["alive"]
    assert peers.due is None


def test_the_number_of_peer_devices_is_bounded() -> None:
    peers = PeerDevices()
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
        ({"protocol": "imu_mpu6050_v1", "timeout": 0.0}, "", 0.0),
        ({"protocol": "pebble_serial_v1", "timeout": 2.0}, "outlets", 2.0),
    ],
)
def test_which_lines_have_a_timeout(section: dict[str, object], instance: str, expected: float) -> None:
    from pebble.config.tree import SerialHealth

    health = SerialHealth(imu_sample_timeout_seconds=section.pop("timeout", None))  # type: ignore[arg-type]
    watchdog = ImuWatchdog(SerialBridge(health=health, **section), instance)  # type: ignore[arg-type]
    assert watchdog.timeout_s == expected
    watchdog.begin(100.0)
    assert watchdog.expired(108.0) == (expected > 0)
    watchdog.sample(108.0)
    assert not watchdog.expired(108.0 + expected)
    watchdog.end()
    assert not watchdog.expired(1000.0)


def test_the_first_sample_may_take_longer() -> None:
    watchdog = ImuWatchdog(SerialBridge(protocol="imu_mpu6050_v1"), "")
    watchdog.begin(0.0)
    assert not watchdog.expired(6.9)
    assert watchdog.expired(7.1)
