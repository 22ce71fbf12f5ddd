"""A gateway with its forwarders in virtual time, between a hub and a broker in memory."""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from pebble.contract import ONLINE
from pebble.errors import PebbleError
from pebble.extensions.fleet.gateway import gateway as module
from pebble.extensions.fleet.gateway.carried_robot import LARGEST, Beginning
from pebble.extensions.fleet.gateway.gateway import SILENT_S, TICK_S, Gateway, will
from pebble.transports import Message, clock
from tests.forwarding.virtual import Connection, Hub
from tests.services.mqtt_bridge.bridge_rig import Client
from tests.support import cases

STEP_S, RECOVERY_S = 0.05, 4.0
GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


class BoardsConnection(Connection):
    """A client of a LAN's broker, to whom live messages look like retained ones."""

    as_published = True

    def receive(self, delivery: Any) -> None:
        message = delivery.message
        retain = message.retain or bool(message.retain_requested)
        super().receive(replace(delivery, message=msgspec.structs.replace(message, retain=retain)))


class Running:
    """A gateway and its connections; while it hangs it does nothing, and what is sent to it waits."""

    def __init__(self, world: World, name: str, *robots: str, hub: type[Connection] = Connection) -> None:
        self.hub, self.broker, self.presence, self.stops = (
            hub(f"{name}-hub", world.hub, world),  # type: ignore[arg-type]
            Connection(f"{name}-forwards", world.broker, world),  # type: ignore[arg-type]
            Connection(f"{name}-presence", world.broker, world, will=will(name)),  # type: ignore[arg-type]
            Connection(f"{name}-stops", world.broker, world),  # type: ignore[arg-type]
        )
        self.gateway = Gateway(name, robots or ["pebble/robots/+"], *self.connections, clock=lambda: world.now)
        self.hangs = False
        self.gateway.open()

    @property
    def connections(self) -> tuple[Connection, ...]:
        return self.hub, self.broker, self.presence, self.stops

    def hang(self) -> None:
        self.hangs = True
        for one in self.connections:
            one.hold()

    def go_on(self) -> None:
        self.hangs = False
        for one in self.connections:
            one.let_go()


class World:
    """Robots at a hub, an operator at a broker, who send numbered commands and events all the time."""

    def __init__(self, *gateways: str, robots: tuple[str, ...] = (GOOB,)) -> None:
        self.now = 100.0
        self.connections: list[Connection] = []
        self.hub, self.broker = Hub(), Hub()
        self.robots = [Client(Connection(base, self.hub, self), base) for base in robots]  # type: ignore[arg-type]
        self.operators = [
            Client(Connection(f"operator of {base}", self.broker, self), base)  # type: ignore[arg-type]
            for base in robots
        ]
        self.silent: set[str] = set()
        self.running = {name: Running(self, name) for name in gateways}
        self._numbers, self.number = itertools.count(1), 0

    def run(self, seconds: float, *, sending: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += STEP_S
            number = self.number = next(self._numbers)
            for robot, operator in zip(self.robots, self.operators, strict=True):
                if sending:
                    operator.publish("incoming/drive-values", json.dumps({"x": 0.5, "z": 0, "n": number}).encode())
                    robot.publish("outgoing/counted", b"%d" % number)
                if number % 5 == 0 and robot.base not in self.silent:
                    robot.publish("outgoing/online", b'{"t": %d}' % number, retain=True)
            self.rest()
            for one in self.running.values():
                if not one.hangs:
                    one.gateway.tick()
            self.rest()

    def rest(self) -> None:
        while any(connection.work() for connection in self.connections):
            pass

    def kill(self, name: str) -> None:
        one = self.running.pop(name)
        for connection in one.connections:
            self.connections.remove(connection)
            (self.hub if connection is one.hub else self.broker).crash(connection)

    def numbers(self) -> list[list[int]]:
        """What each robot and each operator has received, in that order."""
        commands = [[json.loads(one)["n"] for one in robot.payloads("incoming/drive-values")] for robot in self.robots]
        events = [[int(one) for one in operator.payloads("outgoing/counted")] for operator in self.operators]
        return commands + events

    def wrong(self) -> int:
        """How many came twice, or after a newer one."""
        return sum(b <= a for each in self.numbers() for a, b in itertools.pairwise(each))

    def all_pass(self) -> bool:
        """Whether all that is sent from now on arrives."""
        self.run(1)
        return all(each[-15:] == list(range(self.number - 14, self.number + 1)) for each in self.numbers())


@pytest.fixture
def alone() -> World:
    world = World("a")
    world.run(3)
    return world


def test_a_robot_is_carried_with_all_that_it_retains() -> None:
    world = World("a")
    (robot,), (operator,) = world.robots, world.operators
    robot.publish("outgoing/capabilities", b'{"v": 1}', retain=True)
    robot.publish("incoming/flags/mqtt-audio", b"true", retain=True)
    robot.publish("incoming/flags/mqtt-video", b"true", retain=True)
    operator.publish("incoming/flags/mqtt-video", b"false", retain=True)
    world.run(3)
    assert operator.payloads("outgoing/capabilities") == [b'{"v": 1}']
    retained = [hub.retained[f"{GOOB}/incoming/flags/mqtt-video"].payload for hub in (world.hub, world.broker)]
    assert retained == [b"false", b"false"], "the broker's flag counts"
    assert operator.payloads("incoming/flags/mqtt-audio") == [b"true"]
    assert world.all_pass()


def test_a_robot_that_is_silent_is_carried_no_more_until_its_will_comes(alone: World) -> None:
    alone.silent.add(GOOB)
    alone.run(SILENT_S - 1, sending=False)
    assert alone.running["a"].gateway.carries == {GOOB}
    alone.run(2, sending=False)
    assert alone.running["a"].gateway.carries == frozenset()
    alone.robots[0].publish("outgoing/online", b'{"t": 0, "online": false}', retain=True)
    alone.run(1, sending=False)
    assert alone.broker.retained[ONLINE.topic(GOOB)].payload == b'{"t": 0, "online": false}'


@pytest.mark.parametrize(
    ("topic", "payload", "retain", "passes"),
    [
        ("incoming/lights-solid", b'{"r": 1}', False, True),
        ("incoming/by/ann/drive-values", b'{"x": 0.1, "z": 0}', False, True),
        ("incoming/by/ann/drive-values", b'{"x": 0.1, "z": 0}', True, False),
        ("incoming/by/ann/flags/mqtt-video", b"true", False, True),
        ("incoming/flags/reboot", b"true", False, True),
        ("incoming/drive-values", b'{"x": 1, "z": 0, "source": "autonomy", "run": 1}', False, False),
        ("outgoing/status", b"{}", False, False),
    ],
)
def test_what_passes_to_a_robot(alone: World, topic: str, payload: bytes, retain: bool, passes: bool) -> None:
    alone.operators[0].publish(topic, payload, retain=retain)
    alone.run(0.2, sending=False)
    assert (payload in alone.robots[0].payloads(topic)) is passes
    assert not any(one.retain or one.retain_requested for one in alone.robots[0].on(topic))


def test_pictures_pass_while_they_are_allowed_until_an_operator_ends_them(alone: World) -> None:
    (robot,), (operator,) = alone.robots, alone.operators

    def passes() -> bool:
        before = len(operator.on("outgoing/front-camera"))
        robot.publish("outgoing/front-camera", b"picture", qos=0)
        alone.run(0.1, sending=False)
        return len(operator.on("outgoing/front-camera")) > before

    def sends(topic: str, payload: bytes, *, retain: bool = False) -> bool:
        operator.publish(topic, payload, retain=retain)
        alone.run(0.1)
        return passes()

    assert not passes(), "the flag is not known"
    assert sends("incoming/flags/mqtt-video", b"true", retain=True), "it is not known who has requested them"
    assert not sends("incoming/front-camera", b'{"enabled": false}')
    assert sends("incoming/front-camera", b'{"enabled": true}')
    assert not sends("incoming/flags/mqtt-video", b"false", retain=True)


def test_commands_of_the_hub_and_what_runs_there_do_not_reach_the_broker(alone: World) -> None:
    for topic in ("incoming/lights-solid", "incoming/estop", "incoming/flags/reboot"):
        alone.robots[0].publish(topic, b'{"hub": 1}')
    alone.run(0.2, sending=False)
    assert [one.topic for one in alone.operators[0].seen if b"hub" in one.payload] == []


@pytest.mark.parametrize("state", ["not heard", "carried", "stops away", "broker flooded"])
def test_a_live_stop_passes_once_in_every_state(state: str) -> None:
    world = World("a")
    gate = world.running["a"]
    world.run(STEP_S if state == "not heard" else 3.0)
    if state == "stops away":
        gate.stops.cut()
    elif state == "broker flooded":
        gate.broker.hold()
    world.rest()
    for topic, stop in (("incoming/estop", b""), ("incoming/by/ann/estop", b'{"stop": "s1"}')):
        world.operators[0].publish(topic, stop)
        world.rest()
        assert world.robots[0].payloads(topic) == [stop]


def test_robots_begin_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits for hub and broker, and a gateway may take hundreds from one that has died."""
    monkeypatch.setattr(module, "TOGETHER", 2)
    robots = tuple(f"pebble/robots/r{number}" for number in range(10))
    world = World("a", robots=robots)
    broker = world.running["a"].broker
    ask = broker.ask

    def slow(topics: Collection[str]) -> None:
        world.now += 0.1
        ask(topics)

    monkeypatch.setattr(broker, "ask", slow)
    while not world.running["a"].gateway.carries:
        world.run(STEP_S)
    began = world.now
    while world.running["a"].gateway.carries != frozenset(robots):
        world.run(STEP_S)
    assert world.now - began <= 4 * (0.1 + STEP_S) + 0.01
    assert world.all_pass()


def test_a_connection_on_which_stops_wait_holds_up_no_command() -> None:
    world = World("a", robots=(GOOB, FRED))
    world.run(3)
    world.running["a"].stops.hold()
    assert world.all_pass()


@pytest.mark.parametrize(
    ("begun_s", "then_s", "waited_s"),
    [(0.4, 0.0, 0.0), (3.0, 0.0, 3.0), (3.0, 0.2, 3.2), (3.0, 0.3, 0.0)],
)
def test_commands_behind_what_is_retained_have_waited_as_long(
    monkeypatch: pytest.MonkeyPatch, begun_s: float, then_s: float, waited_s: float
) -> None:
    now = [100.0]
    monkeypatch.setattr(clock, "since_boot", lambda: now[0])
    beginning = Beginning()
    with beginning:
        now[0] += begun_s
    with beginning:  # another robot
        now[0] += then_s
    assert beginning.aged(Message("a/b/c/incoming/drive-values", b"")).waited_s == pytest.approx(waited_s)


def test_a_message_that_the_broker_would_hang_up_on_does_not_pass(alone: World) -> None:
    for size in (LARGEST, LARGEST + 1):
        alone.robots[0].publish("outgoing/status", b"x" * size)
    alone.rest()
    assert [len(one) for one in alone.operators[0].payloads("outgoing/status")] == [LARGEST]


def test_at_a_broker_of_boards_the_second_heartbeat_shows_a_robot() -> None:
    """The first may be a retained one."""
    world = World()
    world.silent.add(GOOB)
    world.running["a"] = Running(world, "a", hub=BoardsConnection)
    world.run(2)
    for number, carried in ((1, set()), (1, set()), (2, {GOOB})):
        world.robots[0].publish("outgoing/online", b'{"t": %d}' % number, retain=True)
        world.run(2 * TICK_S)
        assert world.running["a"].gateway.carries == carried
    assert world.all_pass()


def test_robots_beyond_the_bound_are_not_carried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ROBOTS", 1)
    world = World("a", robots=(GOOB, FRED))
    world.run(3)
    assert world.running["a"].gateway.carries == {GOOB}
    world.operators[1].publish("incoming/estop", b"")
    world.rest()
    assert world.robots[1].payloads("incoming/estop") == [b""], "no bound concerns a stop"


# -- other gateways


def test_a_second_one_does_not_start_and_names_the_first(alone: World) -> None:
    alone.running["b"] = Running(alone, "b")
    with pytest.raises(PebbleError, match=f"gateway b does not start: a carries {GOOB} already"):
        alone.run(3)
    del alone.running["b"]
    assert alone.all_pass()
    assert alone.wrong() == 0


@pytest.mark.parametrize("name", ["b", "a"])
def test_it_starts_once_the_first_has_gone(alone: World, name: str) -> None:
    """Its will tells so, or its silence; what is retained of it counts for nothing."""
    alone.kill("a")
    alone.broker.retained[will("a").topic] = Message(
        will("a").topic, b'{"t": 1, "run": "f", "robots": ["%s"]}' % GOOB.encode(), retain=True
    )
    alone.operators[0].publish("incoming/estop", b"old", retain=True)
    alone.running[name] = Running(alone, name)
    alone.run(3)
    assert alone.all_pass()
    assert alone.robots[0].payloads("incoming/estop") == [], "a stop that is retained is no live one"


def test_gateways_of_other_robots_share_a_broker() -> None:
    world = World(robots=(GOOB, FRED))
    world.running = {"a": Running(world, "a", GOOB), "b": Running(world, "b", FRED)}
    world.run(3)
    assert [one.gateway.carries for one in world.running.values()] == [{GOOB}, {FRED}]
    assert world.all_pass()


def test_after_an_outage_it_says_nothing_of_before(alone: World) -> None:
    heartbeat, suffix = will("a").topic, ONLINE.suffix
    other = Client(Connection("other", alone.broker, alone), heartbeat.removesuffix(f"/{suffix}"))  # type: ignore[arg-type]
    alone.running["a"].presence.cut()
    alone.run(1)
    del alone.broker.retained[heartbeat]  # its will does so
    other.seen.clear()
    alone.running["a"].presence.mend()
    alone.run(1)
    assert {tuple(json.loads(one)["robots"]) for one in other.payloads(suffix) if one} == {()}


@pytest.mark.parametrize("names", [("a", "b"), ("a", "a")])
def test_of_two_that_begin_together_one_leaves_the_robots(names: tuple[str, str]) -> None:
    world = World()
    world.running = {number: Running(world, name) for number, name in enumerate(names)}  # type: ignore[misc]
    world.run(4)
    assert sorted(len(one.gateway.carries) for one in world.running.values()) == [0, 1]
    assert world.all_pass()


@pytest.mark.parametrize("seed", range(cases(4, 200)))
def test_nothing_comes_twice_or_out_of_order_whatever_fails(seed: int) -> None:
    chance = random.Random(seed)
    world = World("a", robots=(GOOB, FRED))
    world.run(4)
    for _ in range(10):
        one = world.running.get("a")
        if one is None:
            world.running["a"] = Running(world, "a")
        else:
            faults: list[Callable[[], object]] = [
                lambda: world.kill("a"),
                *((one.go_on, one.go_on) if one.hangs else (one.hang,)),
                *(each.cut for each in one.connections),
                *(each.mend for each in one.connections),
                # Not the broker's alone: the hub in memory queues what was not subscribed to yet, which no broker does.
                *(each.hold for each in (one.hub, one.presence, one.stops)),
                *(each.let_go for each in one.connections if not one.hangs),
            ]
            chance.choice(faults)()
        world.run(chance.choice((0.2, 0.7, 1.5, 3.0)))
        assert world.wrong() == 0
    one = world.running.get("a") or Running(world, "a")
    world.running["a"] = one
    for each in one.connections:
        each.mend()
    one.go_on()
    world.run(RECOVERY_S)
    assert world.wrong() == 0
    assert world.all_pass()
