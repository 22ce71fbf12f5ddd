"""What is forwarded comes back by another way: it stops, one error says so, and it goes on when the way is gone."""

from __future__ import annotations

import logging
from collections.abc import Callable

import pytest

from pebble.forwarding.cycles import Cycles, Finding
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subjects
from pebble.services.mqtt_bridge.requests.actions import Action
from pebble.transports import Message, QoS
from tests.forwarding.test_forwarding import grows_no_more
from tests.forwarding.virtual import Connection, Running, World
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, make_config
from tests.support import Clock, errors

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
DRIVE, ESTOP = "incoming/drive-values", "incoming/estop"
TOPIC = f"{BASE}/{DRIVE}"
SUBJECTS = Subjects(make_config())
MOVE, ZERO = b'{"z": 0.5}', b'{"z": 0}'


class Way:
    """Another way between the brokers: what it carries, and whether out of the robot's, in to it, or both."""

    def __init__(self, world: World, direction: str, carried: str) -> None:
        here, there = (Connection("way", hub, world).open(0.0) for hub in (world.local_hub, world.remote_hub))
        ways = {"out": [(here, there)], "in": [(there, here)]}
        self._subscriptions = [
            begin.subscribe(f"{BASE}/{carried}", self._onto(end), echo=False, direct=True)
            for begin, end in ways.get(direction, [(here, there), (there, here)])
        ]

    @staticmethod
    def _onto(end: Connection) -> Callable[[Message], None]:
        def pass_on(message: Message) -> None:
            if not message.retain:
                end.publish(message.topic, message.payload, qos=QoS.DELIVERED, retain=bool(message.retain_requested))

        return pass_on

    def cut(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World("bridge", monkeypatch)


def started(world: World, *, mirroring: bool = False) -> Running:
    running = world.start()
    world.run()
    running.service.forwarder.mirroring.switch(on=mirroring)
    return running


def arrives(world: World, client: Client, suffix: str, payload: bytes) -> bool:
    """True if what the other client publishes now arrives once."""
    before = len(client.payloads(suffix))
    (world.remote if client is world.local else world.local).publish(suffix, payload)
    world.run(1)
    return client.payloads(suffix)[before:] == [payload]


@pytest.mark.parametrize("mirroring", [False, True])
@pytest.mark.parametrize("carried", [DRIVE, "incoming/#"])
@pytest.mark.parametrize("direction", ["in", "out", "both"])
def test_commands_come_to_rest_and_pass_again_when_the_way_is_gone(
    world: World, caplog: pytest.LogCaptureFixture, direction: str, carried: str, mirroring: bool
) -> None:
    caplog.set_level(logging.INFO)
    way = Way(world, direction, carried)
    started(world, mirroring=mirroring)
    for payload in (*[MOVE] * 20, ZERO):
        world.remote.publish(DRIVE, payload)
        world.run(0)
    circulate = mirroring or direction != "in"
    assert len(errors(caplog)) == circulate
    assert all(TOPIC in error for error in errors(caplog))
    world.run(3)
    assert len(errors(caplog)) == circulate
    way.cut()
    world.run(5)
    assert arrives(world, world.local, DRIVE, b"again")
    again = [record for record in caplog.records if "everything is forwarded again" in record.getMessage()]
    assert len(again) == circulate


@pytest.mark.parametrize("after", [0, 1], ids=["at rest", "after one"])
@pytest.mark.parametrize(
    ("suffix", "at_most"), [("incoming/flags/reboot", 1), ("incoming/dance", 2), ("incoming/autonomy-command", 2)]
)
def test_what_runs_something_runs_it_once(
    world: World, monkeypatch: pytest.MonkeyPatch, suffix: str, at_most: int, after: int
) -> None:
    monkeypatch.setattr(Action, "request", lambda _action: True)
    started(world)
    runs = []
    for number, payload in enumerate((b"true", b"true", b'{"a": 1}', b"true")):
        if number == after:
            Way(world, "out", suffix)
        before = len(world.local.payloads(suffix))
        world.remote.publish(suffix, payload)
        world.run(3.1)
        assert set(world.local.payloads(suffix)[before:]) == {payload}
        runs.append(len(world.local.payloads(suffix)) - before)
    assert max(runs) <= at_most, runs
    assert sum(runs) < 4 + at_most, "only one of them comes back"
    assert runs[3] == 1


@pytest.mark.parametrize("suffix", ["outgoing/status", "outgoing/weather"])
def test_what_leaves_the_robot(world: World, caplog: pytest.LogCaptureFixture, suffix: str) -> None:
    way = Way(world, "in", suffix)
    started(world)
    for number in range(3):
        world.local.publish(suffix, b'{"n": %d}' % number)
    world.run(0)
    assert arrives(world, world.remote, suffix, b'{"n": 3}')
    assert len(errors(caplog)) == 1
    way.cut()
    world.run(3)
    assert arrives(world, world.remote, suffix, b'{"n": 3}')


@pytest.mark.parametrize("stop", [b'{"stop": "00000000000000a1"}', b"{}"])
def test_stops_come_to_rest_and_each_repetition_arrives(world: World, stop: bytes) -> None:
    Way(world, "both", "incoming/#")
    started(world, mirroring=True)
    for _ in range(10):
        before = len(world.local.seen)
        world.remote.publish(ESTOP, stop)
        world.run(0.5)
        assert [message for message in world.local.seen[before:] if message.topic.endswith(ESTOP)]


def test_a_second_robot_with_this_id(world: World, caplog: pytest.LogCaptureFixture) -> None:
    started(world, mirroring=True)
    started(world, mirroring=True)
    for client in (world.remote, world.local):
        for payload in (MOVE, ZERO):
            client.publish(DRIVE, payload)
        client.publish("incoming/dance", b"1")
        client.publish(ESTOP, b"{}")
        world.run(0)
    world.run(3)
    assert 1 <= len(errors(caplog)) <= 2  # the first to notice ends it for both
    world.stop()
    world.run(8)
    assert arrives(world, world.local, DRIVE, b"again")


def test_a_held_key_causes_one_probe_a_second(world: World) -> None:
    started(world)
    before = len(world.local.probes)
    for _ in range(100):
        world.remote.publish(DRIVE, MOVE)
        world.run(0.049)
    assert world.local.payloads(DRIVE) == [MOVE] * 100
    assert 4 <= sum(probe.topic == TOPIC for probe in world.local.probes[before:]) <= 6


def test_probes_of_others_are_forwarded_once_and_prove_nothing(world: World) -> None:
    started(world)
    probe = b" \t" * 16
    for _ in range(2):
        world.remote.publish(DRIVE, probe)
    world.run(0)
    assert [message.payload for message in world.local.probes].count(probe) == 1
    assert arrives(world, world.local, DRIVE, MOVE)


def examine(cycles: Cycles, side: Side, topic: str, payload: bytes) -> Finding:
    """Any topic but that of stops is one of drive commands."""
    subject = SUBJECTS[f"{BASE}/{topic}" if topic == ESTOP else TOPIC]
    assert subject is not None
    return cycles.examine(side, subject, Message(topic, payload))


def test_a_probe_that_comes_back_where_it_was_sent_proves_nothing() -> None:
    cycles = Cycles(Clock())
    probe = cycles.probe(REMOTE, TOPIC)
    assert examine(cycles, LOCAL, TOPIC, probe) is Finding.PROBE
    assert cycles.closed_ways == set()
    assert examine(cycles, REMOTE, TOPIC, probe) is Finding.PROBE
    assert cycles.closed_ways == {(REMOTE, TOPIC)}


def test_memory_is_bounded() -> None:
    cycles = Cycles(Clock())

    def fill(number: int) -> None:
        topic = f"{TOPIC}/{number}"
        examine(cycles, REMOTE, topic, cycles.probe(REMOTE, topic))
        examine(cycles, REMOTE, TOPIC, b"%d" % number)
        examine(cycles, LOCAL, TOPIC, bytes(b" \t"[number >> digit & 1] for digit in range(32)))
        examine(cycles, REMOTE, ESTOP, b"%d" % number)

    assert grows_no_more(fill, 3000)
    assert len(cycles.closed_ways) == 256
