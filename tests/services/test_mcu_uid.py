"""Two devices with one uid, and what they claim of the robot's channels: without a line, without a clock."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from pebble.config import SerialBridge
from pebble.payloads import McuManifest
from pebble.services.serial_mcu_bridge.aliases import claims
from pebble.services.serial_mcu_bridge.imu_watchdog import ImuWatchdog
from pebble.services.serial_mcu_bridge.manifest import parse_describe
from pebble.services.serial_mcu_bridge.neighbours import CONFIRM_S, Neighbours
from pebble.services.serial_mcu_bridge.uid_claim import AGAIN_S, ASK_S, Move, UidClaim
from tests.services import mcu_wire as wire
from tests.services.mcu_wire import IMU, STATION, F, I, M

# -- uids


def test_who_asks_and_hears_nothing_has_it() -> None:
    claim = UidClaim("a")
    assert claim.want("u", 0.0) is Move.ASK
    assert claim.tick(ASK_S - 0.01) is Move.NOTHING
    assert claim.tick(ASK_S) is Move.HOLD
    assert claim.due is None
    assert claim.hear_question("u", "b", 1.0) is Move.ANSWER
    assert claim.hear_question("other", "b", 1.0) is Move.NOTHING
    assert claim.hear_question("u", "a", 1.0) is Move.NOTHING, "our own question, come back"
    assert claim.hear_manifest("u", 1.0) is Move.INSIST, "ours come back, or somebody has it too"


def test_of_two_who_both_have_it_the_weaker_gives_it_up() -> None:
    weak, strong = UidClaim("a"), UidClaim("b")
    for claim in (weak, strong):
        claim.want("u", 0.0)
        assert claim.tick(ASK_S) is Move.HOLD
    assert strong.hear_question("u", "a", 1.0, has=True) is Move.INSIST
    assert weak.hear_question("u", "b", 1.0, has=True) is Move.YIELD
    assert weak.due == 1.0 + AGAIN_S


def test_who_asks_yields_to_who_has_it_whatever_the_tokens() -> None:
    claim = UidClaim("z")
    claim.want("u", 0.0)
    assert claim.hear_question("u", "a", 0.1, has=True) is Move.YIELD


def test_who_is_answered_waits_and_asks_again() -> None:
    claim = UidClaim("z")
    claim.want("u", 0.0)
    assert claim.hear_manifest("other", 0.1) is Move.NOTHING
    assert claim.hear_manifest("u", 0.1) is Move.YIELD
    assert claim.due == 0.1 + AGAIN_S
    assert claim.hear_question("u", "b", 1.0) is Move.NOTHING
    assert claim.tick(0.1 + AGAIN_S) is Move.ASK
    assert claim.hear_manifest("u", 6.0) is Move.YIELD
    assert claim.hear_leaving("u", 7.0) is Move.ASK
    assert claim.tick(7.0 + ASK_S) is Move.HOLD


def test_who_has_released_it_says_nothing() -> None:
    claim = UidClaim("a")
    claim.want("u", 0.0)
    claim.release()
    assert claim.tick(10.0) is Move.NOTHING
    assert claim.hear_question("u", "b", 10.0) is Move.NOTHING


@dataclass
class Fabric:
    """Claims that hear one another after ``delay`` s, and themselves too."""

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
                    self.act(token, self.claims[token].want("u", now), now)
            for _, what, sender in due:
                for token, claim in self.claims.items():
                    hear = claim.hear_question("u", sender, now) if what == "ASK" else claim.hear_manifest("u", now)
                    self.act(token, hear, now)
            for token, claim in self.claims.items():
                self.act(token, claim.tick(now), now)


@pytest.mark.parametrize("delay", [0.001, 0.02, 0.09])
@pytest.mark.parametrize("later", [0.0, 0.001, 0.05, 0.15, 0.3, 3.0])
@pytest.mark.parametrize("tokens", ["ab", "ba"])
def test_of_two_exactly_one_has_it(delay: float, later: float, tokens: str) -> None:
    fabric = Fabric(delay)
    fabric.run({tokens[0]: 0.0, tokens[1]: later}, 12.0)
    assert len(fabric.holders) == 1


def test_of_five_at_once_exactly_one_has_it() -> None:
    fabric = Fabric(0.01)
    fabric.run(dict.fromkeys("cadbe", 0.0), 12.0)
    assert fabric.holders == {"e"}


# -- claims


def published(manifest: M) -> McuManifest:
    return parse_describe(manifest.describe()).payload()


def state(name: str, channel: str, number: int = 1, **more: object) -> I:
    fields = {"id": number, "name": name, "dir": wire.OUT, "kind": wire.KIND_STATE, "fields": (F("v", wire.U8),)}
    return I(**{**fields, "channel": channel, **more})  # type: ignore[arg-type]


def command(name: str, channel: str, number: int = 1) -> I:
    return I(number, name, wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), channel)


def test_the_devices_of_the_original_get_all_they_ask_for() -> None:
    assert claims(published(IMU)).granted == {
        "outgoing/sensors/imu-fast": "imu_fast",
        "outgoing/sensors/imu": "imu",
    }
    station = claims(published(STATION))
    assert not station.refused
    assert station.granted["incoming/outlets/o3/power"] == "o3_set"
    assert station.granted["outgoing/outlets/o3/status"] == "o3_state"


def test_a_channel_nobody_knows_is_free_in_both_directions() -> None:
    both = M("u", (state("a", "lamp/one"), command("b", "lamp/one", 2)))
    assert claims(published(both)).granted == {"outgoing/lamp/one": "a", "incoming/lamp/one": "b"}


def test_the_second_of_a_device_is_refused() -> None:
    twice = claims(published(M("u", (state("a", "lamp"), state("b", "lamp", 2)))))
    assert twice.granted == {"outgoing/lamp": "a"}
    assert twice.refused == {"b": "outgoing/lamp: a has it already"}


@pytest.mark.parametrize("channel", [
    "drive-values", "lights-solid", "front-camera", "audio", "audio-stream", "soundboard-command", "autonomy-command",
    "flags/reboot", "flags/mqtt-video", "flags/anything", "flags", "mip-raw", "mcu/other/led", "mcu",
])  # fmt: skip
def test_nobody_may_take_what_commands_the_robot(channel: str) -> None:
    assert "robot's own" in claims(published(M("u", (command("a", channel),)))).refused["a"]


@pytest.mark.parametrize("channel", [
    "online", "heartbeat", "capabilities", "status", "logs", "charging-status", "charging-level", "touch-sensors",
    "front-camera", "audio", "wheel-odometry", "flags/mqtt-video", "mcu/other/describe", "bridge-probe",
])  # fmt: skip
def test_nobody_may_speak_for_the_robot(channel: str) -> None:
    assert "robot's own" in claims(published(M("u", (state("a", channel),)))).refused["a"]


@pytest.mark.parametrize("channel", ["sensors/imu", "sensors/imu-fast"])
def test_an_inertial_channel_needs_its_profile_and_fields(channel: str) -> None:
    for profile in ("", "imu.motion.v1", "imu.summary.v1"):
        refused = claims(published(M("u", (state("a", channel, profile=profile),)))).refused
        assert "it needs the profile imu." in refused["a"]


def test_what_stays_on_the_robot_gets_no_channel_that_leaves_it_without_a_name() -> None:
    """The bridge tells by `device_uid`, which the body of sensors/imu has not."""
    hidden = IMU.but(interfaces=tuple(I(**{**vars(one), "flags": wire.LOCAL_ONLY}) for one in IMU.interfaces))
    hidden_claims = claims(published(hidden))
    assert hidden_claims.granted == {"outgoing/sensors/imu-fast": "imu_fast"}
    assert "it may leave the robot" in hidden_claims.refused["imu"]


def test_a_channel_that_the_config_renames_is_the_robots_own_too() -> None:
    from pebble.contract import DRIVE

    taken = claims(published(M("u", (command("a", "elsewhere"),))), {"incoming/elsewhere": DRIVE}.get)
    assert "robot's own" in taken.refused["a"]


def test_manifests_of_strangers_raise_nothing() -> None:
    odd = McuManifest(protocol="x", schema_version=1, interface_count=1, schema_hash="", device_uid="u",
                      firmware_version="", model="", interfaces=[
                          {}, {"channel": 5}, {"channel": "a", "encoding": 7}, {"channel": "sensors/imu",
                           "profile": "imu.summary.v1", "encoding": {"fields": [1, {}, None]}}])  # fmt: skip
    assert claims(odd).granted == {"outgoing/a": "None"}


# -- neighbours


def test_a_neighbour_claims_until_it_leaves() -> None:
    neighbours = Neighbours()
    neighbours.hear("b", frozenset({"outgoing/x", "outgoing/y"}), 0.0, kept=False)
    neighbours.hear("a", frozenset({"outgoing/x"}), 0.0, kept=False)
    assert neighbours.claimants("outgoing/x") == ["a", "b"]
    assert neighbours.claimants("outgoing/y") == ["b"]
    assert neighbours.due is None
    neighbours.forget("b")
    assert neighbours.claimants("outgoing/y") == []


def test_a_kept_manifest_counts_until_nobody_stood_up_for_it() -> None:
    neighbours = Neighbours()
    neighbours.hear("ghost", frozenset({"outgoing/x"}), 10.0, kept=True)
    neighbours.hear("alive", frozenset({"outgoing/x"}), 10.0, kept=True)
    assert neighbours.due == 10.0 + CONFIRM_S
    neighbours.hear("alive", frozenset({"outgoing/x"}), 10.1, kept=False)
    assert neighbours.left_over(10.0 + CONFIRM_S - 0.01) == []
    assert neighbours.claimants("outgoing/x") == ["alive", "ghost"]
    assert neighbours.left_over(10.0 + CONFIRM_S) == ["ghost"]
    assert neighbours.claimants("outgoing/x") == ["alive"]
    assert neighbours.due is None


def test_strangers_cannot_fill_the_memory() -> None:
    neighbours = Neighbours()
    for number in range(1000):
        neighbours.hear(f"u{number}", frozenset({"outgoing/x"}), 0.0, kept=False)
    assert len(neighbours.claimants("outgoing/x")) == 256


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
def test_who_is_watched(section: dict[str, object], instance: str, expected: float) -> None:
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
