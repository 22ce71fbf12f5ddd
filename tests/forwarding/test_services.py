"""Bridge and mirror between two networks in virtual time: rows of what happens, and what both sides have afterwards."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from itertools import groupby
from typing import Any

import pytest

from pebble.forwarding.event_buffer import LIMIT
from pebble.forwarding.probes import NO_PROBE, PROBE_REQUEST
from pebble.forwarding.routing import Side
from pebble.forwarding.service import CHECK_AGAIN_S
from pebble.forwarding.side import Gate
from pebble.services.mqtt_bridge.requests.actions import Action
from pebble.transports.base import Answer
from tests.forwarding.virtual import Hub, Running, World
from tests.services.mqtt_bridge.bridge_rig import BASE, Client
from tests.support import errors

DRIVE, STOP, RESET = "incoming/drive-values", "incoming/estop", "incoming/estop-reset"
ESTOP_STATE = "outgoing/estop/mcu"
LIGHTS, EVENT = "incoming/lights-solid", "outgoing/somebody/happened"
STATUS, READING, ONLINE = "outgoing/status", "outgoing/programs/reading", "outgoing/online"
FLAG, MIRROR_FLAG = "incoming/flags/mqtt-video", "incoming/flags/remote-mirror"
REBOOT, GIT_PULL = "incoming/flags/reboot", "incoming/flags/git-pull"
TRUE = b"true"
NOTHING_LOCAL = b'{"topics": []}'  # of what an MCU has
Make = Callable[..., World]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Make:
    return lambda service="bridge", **options: World(service, monkeypatch, **options)


@pytest.fixture(params=["bridge", "mirror"])
def world(request: pytest.FixtureRequest, make: Make) -> World:
    return make(request.param)


@pytest.fixture
def bridge(make: Make) -> World:
    return make()


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The actions that would have run."""
    ran: list[str] = []
    monkeypatch.setattr(Action, "request", lambda action: bool(ran.append(action.name)) or True)
    return ran


def sides(world: World) -> tuple[tuple[Client, Client], tuple[Client, Client]]:
    """Who publishes, and who listens."""
    return (world.local, world.remote), (world.remote, world.local)


def do(world: World, history: str) -> None:
    """Words: ``L:x`` and ``R:x``, who sets the flag (``Lonce:x``: does not repeat it), and what the service meets."""
    world.run()
    words: dict[str, Callable[[], object]] = {
        "start": world.start,
        "alone": lambda: (world.start(), world.uplink.cut()),
        **world.interruptions(),
    }
    for word in history.split():
        who, colon, value = word.partition(":")
        if colon:
            client = world.local if who[0] == "L" else world.remote
            client.publish(FLAG, value.encode(), retain=True, remember="once" not in who)
        else:
            words[word]()
        world.run()


class TestFlags:
    """Which value both sides have afterwards, and which changes each side's clients have received."""

    @pytest.mark.parametrize(
        ("service", "history", "value", "local", "remote"),
        [
            ("bridge", "L:1 R:0 start", "0", "0", ""),  # the winner's counts, once: no flapping
            ("mirror", "L:1 R:0 start", "1", "", "1"),
            *((each, "L:1 start", "1", "", "1") for each in ("bridge", "mirror")),
            *((each, "R:1 start", "1", "1", "") for each in ("bridge", "mirror")),
            ("bridge", "L:1 R:0 alone mend", "0", "0", ""),
            ("mirror", "L:1 R:0 alone mend", "1", "", "1"),
            *((each, "R:0 alone L:1 mend", "1", "", "1") for each in ("bridge", "mirror")),
            *((each, "start R:0 L:1", "1", "0", "1") for each in ("bridge", "mirror")),
            *((each, "start R:0 cut L:1 mend", "1", "0", "1") for each in ("bridge", "mirror")),
            ("bridge", "start L:1 cut R:0 mend", "0", "0", "1"),
            ("mirror", "start L:1 cut R:0 mend", "1", "", "1"),
            *((each, "start L:0 away R:1 back", "1", "1", "0") for each in ("bridge", "mirror")),
            ("bridge", "start Ronce:0 Ronce:1 cut Ronce:0 mend", "0", "0 1 0", ""),  # chosen again, and no older one
            ("bridge", "start R:1 stop start", "1", "1", ""),
            ("mirror", "start R:1 stop start", "1", "1", "1"),
            *((each, "start L:1 R:", "", "", "1") for each in ("bridge", "mirror")),
            # a microphone that was switched off after the save of a broker or hub stays off
            ("bridge", "start save R:1 Lonce:0 local-restored-late", "0", "1 0", "0"),
            ("bridge", "start Lonce:1 save R:0 stop local-restored start", "0", "0 1 0", "1"),
            ("bridge", "start R:1 save R:0 local-restored", "0", "1 0 1 0", ""),
            ("mirror", "start R:1 save R:0 remote-restored", "0", "1 0", "1 0"),
        ],
    )
    @pytest.mark.parametrize("as_published", [False, True])
    def test_histories(
        self, make: Make, service: str, history: str, value: str, local: str, remote: str, as_published: bool
    ) -> None:
        world = make(service)
        world.as_published = as_published
        do(world, history)
        expected = value.encode() or None
        assert world.retained(FLAG) == (expected, expected)
        seen = [[one for one, _ in groupby(client.payloads(FLAG)) if one] for client in (world.local, world.remote)]
        assert seen == [one.encode().split() for one in (local, remote)], "no flapping"

    def test_the_mirrors_local_side_wins_and_its_broker_fills_the_rest(self, make: Make) -> None:
        mirror = make("mirror")
        for suffix, payload in ((STATUS, b"yesterday"), (READING, b"mine"), (DRIVE, b"stale"), (REBOOT, TRUE)):
            mirror.remote.publish(suffix, payload, retain=True)
        for suffix, payload in ((STATUS, b"today"), (LIGHTS, b"stale")):
            mirror.local.publish(suffix, payload, retain=True)
        do(mirror, "start")
        assert mirror.retained(STATUS) == (b"today", b"today")
        assert mirror.retained(READING) == (b"mine", b"mine")
        assert mirror.retained(DRIVE) == (None, b"stale"), "not ours to remove"
        assert (mirror.retained(REBOOT), mirror.retained(LIGHTS)) == ((None, TRUE), (b"stale", None))
        assert {message.topic for message in mirror.local.seen} == {f"{BASE}/{READING}"}
        assert not mirror.remote.on(LIGHTS)

    @pytest.mark.parametrize("forgetful", ["local", "remote"])
    def test_a_side_that_lost_a_value_receives_the_newest(self, world: World, forgetful: str) -> None:
        """Also if the last value that was sent there is older."""
        do(world, f"start Ronce:0 Lonce:1 {forgetful}-forgets")
        assert world.retained(FLAG) == (b"1", b"1")


@pytest.mark.parametrize("side", [0, 1], ids=["local", "remote"])
def test_actions_run_once_from_either_side(bridge: World, ran: list[str], side: int) -> None:
    do(bridge, "start")
    client, other = sides(bridge)[side]
    for payload in (b"false", b"1", b"", b"[true]", b"\xff", b'{"value": true}'):
        client.publish(GIT_PULL, payload)
    bridge.run()
    assert ran == ["flags/git-pull"]
    assert other.payloads(GIT_PULL)[-1:] == [b'{"value": true}']


class TestStops:
    def test_a_live_one_passes_although_it_asks_to_be_retained_and_a_retained_one_does_not(self, world: World) -> None:
        for client, _ in sides(world):
            client.publish(STOP, b"old", retain=True)
        do(world, "start")
        world.local.publish(MIRROR_FLAG, TRUE, retain=True)
        world.run()
        local, remote = b'{"stop":"00000000000000a1"}', b'{"stop":"00000000000000b2"}'
        for stop, (client, _) in zip((local, remote), sides(world), strict=True):
            client.publish(STOP, stop, retain=True)
        do(world, "cut mend away back")
        assert world.remote.payloads(STOP) == [local]
        assert world.local.payloads(STOP) == [remote]
        assert world.retained(STOP) == (local, remote)  # each its publisher's own

    def test_one_from_before_anything_is_forwarded_is_not_delivered_later(self, world: World) -> None:
        """Its sender repeats it. A stop from before an outage must not stop the robot after it."""
        do(world, "alone")
        world.local.publish(MIRROR_FLAG, TRUE, retain=True)
        for retain in (False, True):
            world.local.publish(STOP, b"{}", retain=retain)
        do(world, "mend")
        world.local.publish(STOP, b"now")
        world.run()
        assert world.remote.payloads(STOP) == [b"now"]


def test_events_of_an_outage_wait_and_beyond_the_bound_the_oldest_go(world: World) -> None:
    do(world, "start cut")
    for number in range(LIMIT + 100):
        world.local.publish(EVENT, b"%d" % number)
    do(world, "mend")
    assert world.remote.payloads(EVENT) == [b"%d" % number for number in range(100, LIMIT + 100)]
    assert world.service.dropped()["events"] == 100


def test_at_each_connection_commands_are_probed(world: World) -> None:
    """Those of the robot's own side only by the mirror."""
    do(world, "start")
    assert len(world.local.probes) >= 4
    assert (len(world.remote.probes) >= 4) == (world.name == "mirror")
    assert all(probe.payload.isspace() for client in (world.local, world.remote) for probe in client.probes)
    before = len(world.local.probes)
    do(world, "cut mend")
    assert len(world.local.probes) >= before + 4


class TestOneBroker:
    """Both sides of the bridge are one network, or become two."""

    @pytest.fixture
    def one(self, make: Make) -> World:
        return make(one=True)

    @pytest.mark.parametrize("enabled", [True, False], ids=["with a heartbeat", "without"])
    def test_nothing_is_forwarded_and_the_heartbeat_is_published(self, one: World, enabled: bool) -> None:
        one.local.publish(STATUS, b"before", retain=True)
        one.start(heartbeat={"enabled": enabled})
        one.run()
        for history in ("", "cut mend", "away back", "local-forgets"):  # still so after an outage
            do(one, history)
            assert one.running[0].gate is Gate.SHUT
            for suffix in (MIRROR_FLAG, FLAG, STATUS, DRIVE, "outgoing/strange"):
                before = len(one.remote.on(suffix))
                one.local.publish(suffix, TRUE)
                one.run()
                assert one.remote.payloads(suffix)[before:] == [TRUE]
        assert (len(one.remote.on(ONLINE)) > 40) == enabled

    def test_actions_run_once(self, one: World, ran: list[str]) -> None:
        one.local.publish(REBOOT, TRUE, retain=True)
        do(one, "start")
        one.remote.publish(GIT_PULL, TRUE)
        one.run()
        assert ran == ["flags/git-pull"]

    def test_a_copied_probe_counts_once_and_for_seconds(self, bridge: World) -> None:
        do(bridge, "start")
        probes = bridge.remote.payloads("outgoing/bridge-probe")
        bridge.local.publish(ONLINE, heartbeat())
        bridge.run()
        assert bridge.remote.payloads("outgoing/bridge-probe") == probes, "another program's heartbeat causes none"
        probe = probes[-1]
        for number in range(20):
            bridge.local.publish("outgoing/bridge-probe", probe, retain=True)
            bridge.run(1)
            bridge.remote.publish(DRIVE, b"%d" % number)
        bridge.run()
        assert len(bridge.local.on(DRIVE)) >= 15

    def test_a_way_that_comes_later_and_goes_again(self, bridge: World) -> None:
        """Probes find it as if another bridge had begun to join the two brokers, without a reconnect.

        Then the bridge subscribes anew: retained stops that this brings do not pass.
        """
        do(bridge, "start")
        assert bridge.running[0].gate is Gate.OPEN
        for client in (bridge.local, bridge.remote):
            client.publish(STOP, b'{"stop":"00000000000000a1"}', retain=True)
        bridge.local.publish(MIRROR_FLAG, TRUE, retain=True)
        joint = bridge.remote.transport.subscribe(
            f"{BASE}/outgoing/#", lambda m: bridge.local.transport.publish(m.topic, m.payload, qos=m.qos), echo=False,
            direct=True,
        )  # fmt: skip
        bridge.run()
        assert bridge.running[0].gate is Gate.SHUT
        joint.close()
        bridge.run(40)
        assert bridge.running[0].gate is Gate.OPEN
        assert (len(bridge.local.on(STOP)), len(bridge.remote.on(STOP))) == (1, 0)


def heartbeat(age_s: float = 0.0, **more: Any) -> bytes:
    return json.dumps({"t": int((time.time() - age_s) * 1000), **more}).encode()


class TestWrongBroker:
    """The mirror's broker is, or seems to be, the remote one, which a bridge on the same robot serves."""

    @pytest.fixture
    def mirror(self, make: Make) -> World:
        return make("mirror")

    @staticmethod
    def is_mirrored(world: World) -> bool:
        """Whether a command at the mirror's broker arrives, by the mirror or the bridge, and what only it forwards."""
        before = len(world.local.on(DRIVE)), len(world.local.on(READING))
        world.remote.publish(DRIVE, b"1")
        world.remote.publish(READING, b"1")
        world.run(1)
        assert len(world.local.on(DRIVE)) == before[0] + 1
        return len(world.local.on(READING)) > before[1]

    @pytest.mark.parametrize("order", [("mirror", "bridge"), ("bridge", "mirror")], ids=" ".join)
    def test_the_remote_one_is_refused(
        self, mirror: World, caplog: pytest.LogCaptureFixture, order: tuple[str, str]
    ) -> None:
        for service in order:
            mirror.start(service, enabled=True, heartbeat={"enabled": order[0] == "mirror"})
            mirror.run()
        assert not self.is_mirrored(mirror)
        (error,) = errors(caplog)
        assert "127.0.0.1:1883 is the remote one" in error

    @pytest.mark.parametrize(
        ("end", "waits_s"),
        [
            (lambda bridge: None, 3.0),  # by then the bridge has noticed that it has no connection
            (lambda bridge: setattr(bridge.uplink, "reply", Answer(2, 0.0, None)), 1.5),
            (lambda bridge: bridge.uplink.cut(), 1.5),
        ],
        ids=["nothing", "it arrives", "the connection is lost"],
    )
    def test_it_waits_for_a_probe_that_is_under_way(
        self, mirror: World, end: Callable[[Running], object], waits_s: float
    ) -> None:
        bridge = mirror.start("bridge", broker=Hub(), enabled=True)
        mirror.run()
        assert mirror.local.payloads("outgoing/bridge-probe").count(NO_PROBE) == 2, "before probes and after all"
        bridge.uplink.reply = Answer(1, 0.0, None, delivered_s=9.0)
        waiting = mirror.start("mirror", enabled=True)
        began = mirror.now
        mirror.run(1.49)
        end(bridge)
        while waiting.gate is Gate.WAITING:
            mirror.run(0.01)
        assert waits_s <= mirror.now - began < waits_s + 0.6
        assert waiting.gate is Gate.OPEN

    @pytest.mark.parametrize("topic", ["outgoing/bridge-probe", ONLINE])
    def test_no_client_of_it_can_stop_the_mirror(self, mirror: World, topic: str) -> None:
        for service, broker in (("bridge", Hub()), ("mirror", mirror.remote_hub)):
            mirror.start(service, broker=broker, enabled=True)
        mirror.run()
        nonce = heartbeat(nonce="0123456789abcdef")
        for payload in (b"x", b"", b"x" * 100_000, heartbeat(), nonce, PROBE_REQUEST, *map(heartbeat, range(-9, 1))):
            mirror.remote.publish(topic, payload, retain=payload == nonce)
            mirror.run(0.1)
            assert mirror.running[1].gate is Gate.OPEN
        mirror.run()
        mirror.remote.publish(DRIVE, b"after")
        mirror.run()
        assert mirror.local.payloads(DRIVE) == [b"after"]

    @pytest.mark.parametrize("history", ["", "cut mend"], ids=["after a while", "at a reconnect"])
    def test_it_is_checked_again(self, mirror: World, history: str) -> None:
        mirror.start()
        for suffix, payload in ((READING, b"gone"), (STATUS, b"old")):
            mirror.local.publish(suffix, payload, retain=True)
        mirror.run()
        mirror.stop()
        for service in ("mirror", "bridge"):
            mirror.start(service, enabled=True)
            mirror.run()
        assert mirror.running[0].gate is Gate.SHUT
        mirror.running[1].uplink.lead_to(Hub())  # the bridge serves another broker from now on
        mirror.local.publish(READING, b"", retain=True)
        mirror.local.publish(STATUS, b"new", retain=True)
        mirror.run()
        do(mirror, history)
        mirror.run(0 if history else CHECK_AGAIN_S)
        assert self.is_mirrored(mirror)
        assert mirror.retained(STATUS) == (b"new", b"new")
        assert mirror.retained(READING) == (None, None)


class TestLeftovers:
    GONE = ("mcu/m1/describe", "mcu/m1/range", "outlets/1/status", "autonomy-status")
    STAYS = ("mcu/m2/describe", "estop/serial", "status")
    FOREIGN = ("incoming/flags/foreign", "outgoing/video", "outgoing/unknown", ONLINE)

    @pytest.mark.parametrize("forgets", [False, True], ids=["the robot has taken it back", "the robot is not there"])
    @pytest.mark.parametrize("profile", ["wide", "auto"])
    def test_what_was_taken_back_while_no_bridge_ran_is_removed_there(
        self, bridge: World, profile: str, forgets: bool
    ) -> None:
        bridge.start()
        bridge.run()
        for uid in ("m1", "m2"):
            bridge.local.publish(f"outgoing/mcu/{uid}/local-only", NOTHING_LOCAL, retain=True)
        for name in (*self.GONE, *self.STAYS):
            bridge.local.publish(f"outgoing/{name}", b'{"interfaces": [{"name": "range"}]}', retain=True)
        bridge.run()
        there = {f"{BASE}/outgoing/{name}" for name in (*self.GONE, *self.STAYS)}
        assert there <= bridge.remote_hub.retained.keys()
        bridge.stop()
        for topic in self.FOREIGN:
            bridge.remote.publish(topic, b"1", retain=True)
        for name in self.GONE:
            bridge.local.publish(f"outgoing/{name}", b"", retain=True)
        if forgets:
            bridge.local_hub.stop(forget=True)
        bridge.start(link={"profile": profile})
        bridge.run(60)
        left = {f"{BASE}/{topic}" for topic in (*self.FOREIGN, *(f"outgoing/{name}" for name in self.STAYS))}
        newest = {f"{BASE}/outgoing/link"} if profile == "auto" else set()
        assert {*bridge.remote_hub.retained} - newest == (there | left if forgets else left)


def test_what_an_mcu_wants_private_stays_private(bridge: World) -> None:
    """But an alias never holds a stop back."""
    do(bridge, "start")
    private, passes = ("outgoing/mcu/imu-1/fast", "outgoing/sensors/extra"), ("outgoing/mcu/imu-1/slow", ESTOP_STATE)
    local = json.dumps({"topics": [*private, STOP, RESET, ESTOP_STATE]}).encode()
    bridge.local.publish("outgoing/mcu/imu-1/local-only", local, retain=True)
    for suffix in (*passes, *private):
        bridge.local.publish(suffix, b"{}")
    for suffix in (STOP, RESET):
        bridge.remote.publish(suffix, b"{}")
    bridge.run()
    assert all(bridge.remote.on(suffix) for suffix in passes)
    assert not [suffix for suffix in private if bridge.remote.on(suffix)]
    assert all(bridge.local.on(suffix) for suffix in (STOP, RESET))


@pytest.mark.parametrize("side", list(Side))
def test_a_stop_is_taken_where_too_many_messages_wait(world: World, side: Side) -> None:
    do(world, "start")
    is_stop = {Side.LOCAL: world.here, Side.REMOTE: world.uplink}[side].policy.is_stop
    found = {suffix: is_stop(f"{BASE}/{suffix}") for suffix in (STOP, RESET, ESTOP_STATE, DRIVE, f"{STOP}/x")}
    assert found == {suffix: suffix == STOP for suffix in found}
