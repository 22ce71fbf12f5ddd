"""What is forwarded comes back by another way: it stops, one error says so, and it goes on when the way is gone."""

from __future__ import annotations

import logging

import pytest

from pebble.forwarding.cycles import Cycles, Finding
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.routing import MIRROR, TABLE_A1, Side
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message
from tests.forwarding.network import Client, Network, Node, Way, bridge
from tests.forwarding.test_forwarding import grows_no_more
from tests.services.mqtt_bridge.bridge_rig import BASE, make_config

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
DRIVE, ESTOP, FLAG = "incoming/drive-values", "incoming/estop", "incoming/flags/mqtt-video"
TOPIC = f"{BASE}/{DRIVE}"
SUBJECTS = Subjects(make_config())
MOVE, ZERO = b'{"z": 0.5}', b'{"z": 0}'


class World:
    """A robot's broker, its operators' broker, and someone on each."""

    def __init__(self) -> None:
        self.network = Network()
        self.local, self.remote = Node(self.network), Node(self.network)
        self.robot = Client(self.local).listen(f"{BASE}/#")
        self.operator = Client(self.remote).listen(f"{BASE}/#")
        self.bridges: list[Forwarder] = []

    def bridge(self, *, mirroring: bool = False, crossed: bool = False, probe: bool = True) -> Forwarder:
        sides = (self.remote, self.local) if crossed else (self.local, self.remote)
        forwarder = bridge(*sides, TABLE_A1, mirroring=mirroring)
        self.bridges.append(forwarder)
        if probe:
            forwarder.publisher.probe_commands(REMOTE)
        return forwarder

    def rests(self, deliveries: int = 500) -> bool:
        return self.network.rests_within(deliveries)

    def send(self, client: Client, suffix: str, *payloads: bytes, retain: bool = False) -> None:
        for payload in payloads:
            client.publish(f"{BASE}/{suffix}", payload, retain=retain)

    def wait(self, seconds: int) -> None:
        for _ in range(seconds):
            self.network.now += 1
            for forwarder in self.bridges:
                forwarder.publisher.probe_again((REMOTE,), forwarder.retained.value)
            assert self.rests()

    def arrives(self, client: Client, suffix: str, payload: bytes) -> bool:
        """Whether what the other client publishes now arrives once."""
        before = len(client.payloads(suffix))
        self.send(self.operator if client is self.robot else self.robot, suffix, payload)
        return self.rests() and client.payloads(suffix)[before:] == [payload]


@pytest.fixture
def world() -> World:
    return World()


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


def infos(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.INFO]


@pytest.mark.parametrize("mirroring", [False, True])
@pytest.mark.parametrize("carried", [DRIVE, "incoming/#"])
@pytest.mark.parametrize("direction", ["in", "out", "both"])
class TestCommands:
    def test_they_come_to_rest_and_pass_again_when_the_way_is_gone(
        self, world: World, caplog: pytest.LogCaptureFixture, direction: str, carried: str, mirroring: bool
    ) -> None:
        caplog.set_level(logging.INFO)
        way = Way(world.local, world.remote, direction, carried)
        world.bridge(mirroring=mirroring)
        for _ in range(20):
            world.send(world.operator, DRIVE, MOVE)
            assert world.rests()
        world.send(world.operator, DRIVE, ZERO)
        assert world.rests()
        circulate = mirroring or direction != "in"
        assert len(errors(caplog)) == circulate
        assert all(TOPIC in error for error in errors(caplog))
        world.wait(3)
        assert len(errors(caplog)) == circulate
        way.cut()
        world.wait(5)
        assert world.arrives(world.robot, DRIVE, b"again")
        assert sum("everything is forwarded again" in info for info in infos(caplog)) == circulate


class TestOthers:
    @pytest.mark.parametrize("carried", ["", "incoming/#"], ids=["one topic", "all topics"])
    @pytest.mark.parametrize("begins", ["before", "at rest", "after one"])
    @pytest.mark.parametrize(
        ("suffix", "at_most"),
        [
            *((f"incoming/flags/{name}", 1) for name in ("reboot", "service-restart", "git-pull")),
            *((f"incoming/{name}", 2) for name in ("dance", "lights-flash", "soundboard-command", "autonomy-command")),
        ],
    )
    def test_what_runs_something_runs_it_once(
        self, world: World, suffix: str, at_most: int, begins: str, carried: str
    ) -> None:
        world.bridge(probe=begins != "before")
        runs = []
        for number, payload in enumerate((b"true", b"true", b'{"a": 1}', b"true")):
            if number == (begins == "after one"):
                Way(world.local, world.remote, "out", carried or suffix)
            before = len(world.robot.payloads(suffix))
            world.send(world.operator, suffix, payload)
            assert world.rests(100)
            assert set(world.robot.payloads(suffix)[before:]) == {payload}
            runs.append(len(world.robot.payloads(suffix)) - before)
            world.network.now += 3
        assert max(runs) <= at_most, runs
        assert runs[2:] == [1, 1]

    @pytest.mark.parametrize("suffix", ["outgoing/status", "outgoing/weather", "outgoing/touch-sensors"])
    def test_outgoing(self, world: World, caplog: pytest.LogCaptureFixture, suffix: str) -> None:
        way = Way(world.local, world.remote, "in", suffix)
        world.bridge()
        for number in range(3):
            world.send(world.robot, suffix, b'{"n": %d}' % number)
        assert world.rests(3000)
        assert world.arrives(world.operator, suffix, b'{"n": 3}')
        assert len(errors(caplog)) == 1
        way.cut()
        world.network.now += 3
        assert world.arrives(world.operator, suffix, b'{"n": 3}')

    @pytest.mark.parametrize("stop", [b'{"stop": "00000000000000a1"}', b"{}", b" "])
    def test_stops_come_to_rest_and_each_repetition_arrives(self, world: World, stop: bytes) -> None:
        Way(world.local, world.remote, "both", "incoming/#")
        world.bridge(mirroring=True)
        for _ in range(10):
            before = len(world.robot.seen)
            world.send(world.operator, ESTOP, stop)
            assert world.rests(100)
            assert [message.payload for message in world.robot.seen[before:] if message.topic.endswith(ESTOP)]
            world.network.now += 0.5

    def test_a_stop_that_is_repeated_quickly_arrives(self, world: World) -> None:
        world.bridge()
        world.send(world.operator, ESTOP, *[b"{}"] * 5)
        assert world.rests()
        assert world.robot.payloads(ESTOP) == [b"{}"] * 5


class TestSeveralBridges:
    @pytest.mark.parametrize("mirroring", [False, True])
    @pytest.mark.parametrize("crossed", [False, True])
    def test_a_second_robot_with_this_id(
        self, world: World, caplog: pytest.LogCaptureFixture, crossed: bool, mirroring: bool
    ) -> None:
        """Between the same brokers; ``crossed``: what is local to one is remote to the other."""
        world.bridge(mirroring=mirroring)
        other = world.bridge(mirroring=mirroring, crossed=crossed)
        for client in (world.operator, world.robot):
            world.send(client, DRIVE, MOVE, ZERO)
            world.send(client, "incoming/dance", b"1")
            world.send(client, FLAG, b"true", b"false", retain=True)
            world.send(client, ESTOP, b"{}")
            assert world.rests(1500)
        world.send(world.robot, "outgoing/status", b"1")
        assert world.rests(300)
        world.wait(3)
        assert 1 <= len(errors(caplog)) <= 2  # the first to notice ends it for both
        other.shut()
        world.wait(5)
        assert world.arrives(world.robot, DRIVE, b"again")

    def test_a_mirror_and_a_way_from_its_broker(self, world: World, caplog: pytest.LogCaptureFixture) -> None:
        mirrored = Node(world.network)
        way = Way(mirrored, world.remote, "both", "incoming/#")
        world.bridge()
        world.bridges.append(bridge(world.local, mirrored, MIRROR))
        world.bridges[-1].publisher.probe_commands(*Side)
        program = Client(mirrored).listen(f"{BASE}/#")
        for client in (world.operator, world.robot, program):
            world.send(client, DRIVE, MOVE, ZERO)
            world.send(client, FLAG, b"true", retain=True)
            assert world.rests(3000)
        assert len(errors(caplog)) == 1  # the bridge's: the mirror relays its probes
        way.cut()
        world.wait(5)
        assert world.arrives(world.robot, DRIVE, b"again")


class TestProbes:
    def test_none_but_commands_is_probed_at_the_start_and_nothing_at_the_operators(self, world: World) -> None:
        world.bridge()
        assert world.rests()
        assert not world.operator.seen
        assert {message.topic for message in world.robot.seen} == {
            TOPIC,
            *(f"{BASE}/incoming/flags/{action}" for action in ("reboot", "service-restart", "git-pull")),
        }
        assert all(message.payload.isspace() and len(message.payload) == 32 for message in world.robot.seen)

    def test_a_held_key_causes_one_a_second(self, world: World) -> None:
        world.bridge(probe=False)
        for _ in range(100):
            world.send(world.operator, DRIVE, MOVE)
            assert world.rests()
            world.network.now += 0.049
        assert world.robot.payloads(DRIVE) == [MOVE] * 100
        assert 4 <= len(world.robot.seen) - 100 <= 6

    def test_a_flags_probe_is_its_value(self, world: World) -> None:
        world.bridge()
        for _ in range(10):
            world.send(world.operator, FLAG, b"true", retain=True)
        assert world.rests()
        values = [message.payload for message in world.robot.seen if message.topic.endswith(FLAG)]
        assert {value.strip() for value in values} == {b"true"}
        assert len(set(values)) == 2

    @pytest.mark.parametrize("payload", [b"not JSON", b"", b'"' + b"x" * 20_000 + b'"'])
    def test_white_space_follows_only_short_json(self, world: World, payload: bytes) -> None:
        world.bridge()
        for _ in range(10):
            world.send(world.robot, "outgoing/weather", payload)
        assert world.rests()
        assert [message.payload for message in world.operator.seen] == [payload] * 10

    def test_those_of_others_are_forwarded_once_and_prove_nothing(self, world: World) -> None:
        world.bridge(probe=False)
        probe = b" \t" * 16
        world.send(world.operator, DRIVE, probe, probe)
        assert world.rests()
        assert [message.payload for message in world.robot.seen] == [probe]
        assert world.arrives(world.robot, DRIVE, MOVE)


def examine(cycles: Cycles, side: Side, topic: str, payload: bytes) -> Finding:
    """Any topic but that of stops is one of drive commands."""
    subject = SUBJECTS[f"{BASE}/{topic}" if topic == ESTOP else TOPIC]
    assert subject is not None
    return cycles.examine(side, subject, Message(topic, payload))


class TestCycles:
    @pytest.fixture
    def network(self) -> Network:
        return Network()

    @pytest.fixture
    def cycles(self, network: Network) -> Cycles:
        return Cycles(network.clock)

    def test_a_probe_that_comes_back_where_it_was_sent_proves_nothing(self, cycles: Cycles) -> None:
        probe = cycles.probe(REMOTE, TOPIC)
        assert examine(cycles, LOCAL, TOPIC, probe) is Finding.PROBE
        assert (REMOTE, TOPIC) not in cycles.closed_ways
        assert examine(cycles, REMOTE, TOPIC, probe) is Finding.PROBE
        assert (REMOTE, TOPIC) in cycles.closed_ways
        assert (LOCAL, TOPIC) not in cycles.closed_ways

    def test_a_late_answer_counts(self, cycles: Cycles, network: Network) -> None:
        probe = cycles.probe(REMOTE, TOPIC)
        network.now += 30
        examine(cycles, REMOTE, TOPIC, probe)
        assert examine(cycles, REMOTE, TOPIC, MOVE) is Finding.CIRCULATES

    def test_three_unanswered_probes_end_it(self, cycles: Cycles, network: Network) -> None:
        examine(cycles, REMOTE, TOPIC, cycles.probe(REMOTE, TOPIC))
        for _ in range(3):
            network.now += 1
            assert cycles.poll() == [(REMOTE, TOPIC)]
            cycles.probe(REMOTE, TOPIC)
        network.now += 1
        assert (REMOTE, TOPIC) in cycles.closed_ways
        assert cycles.poll() == []
        assert examine(cycles, REMOTE, TOPIC, MOVE) is Finding.PASS

    @pytest.mark.parametrize(
        ("arrives", "logged"),
        [((), 1), ((REMOTE,), 0), ((LOCAL,), 1), ((REMOTE, REMOTE), 1)],
        ids=["none", "on the same way", "on another way", "not from that way: it comes back"],
    )
    def test_a_mirror_logs_an_error_unless_another_bridge_probes_the_way(
        self, network: Network, caplog: pytest.LogCaptureFixture, arrives: tuple[Side, ...], logged: int
    ) -> None:
        cycles = Cycles(network.clock, yields=True)
        examine(cycles, REMOTE, TOPIC, cycles.probe(REMOTE, TOPIC))
        for _ in range(5):
            network.now += 1
            theirs = Cycles(network.clock).probe(LOCAL, FLAG)
            for side in arrives:
                examine(cycles, side, FLAG, theirs)
            for side, topic in cycles.poll():
                examine(cycles, side, topic, cycles.probe(side, topic))
        assert (REMOTE, TOPIC) in cycles.closed_ways
        assert len(errors(caplog)) == logged

    @pytest.mark.parametrize(("both", "logged"), [(True, 0), (False, 1)])
    def test_a_probe_the_other_way_counts_only_if_that_circulates_too(
        self, network: Network, caplog: pytest.LogCaptureFixture, both: bool, logged: int
    ) -> None:
        cycles = Cycles(network.clock, yields=True)
        for side in (REMOTE, LOCAL) if both else (REMOTE,):
            examine(cycles, side, TOPIC, cycles.probe(side, TOPIC))
        for _ in range(4):
            network.now += 1
            examine(cycles, LOCAL, FLAG, Cycles(network.clock).probe(REMOTE, FLAG))
            cycles.poll()
        assert len(errors(caplog)) == logged

    def test_memory_is_bounded(self, cycles: Cycles) -> None:

        def fill(number: int) -> None:
            topic = f"{TOPIC}/{number}"
            examine(cycles, REMOTE, topic, cycles.probe(REMOTE, topic))
            examine(cycles, REMOTE, TOPIC, b"%d" % number)
            examine(cycles, LOCAL, TOPIC, bytes(b" \t"[number >> digit & 1] for digit in range(32)))
            examine(cycles, REMOTE, ESTOP, b"%d" % number)

        assert grows_no_more(fill, 3000)
        assert len(cycles.closed_ways) == 256
