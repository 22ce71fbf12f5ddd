"""Gateways with their forwarders in virtual time, between a hub and a broker in memory."""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Callable, Collection, Sequence

import pytest

from pebble.contract import ONLINE
from pebble.forwarding.routing import Side
from pebble.services.gateway import carried_robots as module
from pebble.services.gateway.carried import Beginning, Carried
from pebble.services.gateway.gateway import Gateway
from pebble.services.gateway.heartbeats import PresentRobots, will
from pebble.services.gateway.ownership import FRESH_S, TAKING_S
from pebble.services.gateway.pace import MOST_EACH, MOST_STOPS, MOST_TOGETHER
from pebble.transports import Message, Transport, clock
from tests.forwarding.virtual import Connection, Hub
from tests.services.mqtt_bridge.bridge_rig import Client
from tests.support import cases

STEP_S, RECOVERY_S = 0.05, 8.0
GOOB = "pebble/robots/goob"


class Running:
    """A gateway and its connections; while it hangs it does nothing, and what is sent to it waits.

    While it ``stands`` its turns do not end, and its other threads go on.
    """

    def __init__(self, world: World, name: str) -> None:
        self.hub, self.broker, self.presence, self.stops = (
            Connection(f"{name}-hub", world.hub, world),  # type: ignore[arg-type]
            Connection(f"{name}-forwards", world.broker, world, will=will(name)),  # type: ignore[arg-type]
            Connection(f"{name}-presence", world.broker, world),  # type: ignore[arg-type]
            Connection(f"{name}-stops", world.broker, world),  # type: ignore[arg-type]
        )
        self.gateway = Gateway(name, ["pebble/robots/+"], *self.connections, clock=lambda: world.now)
        self.hangs = self.stands = False
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
                    one.gateway.publish_heartbeat()
                if not (one.hangs or one.stands):
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


def test_a_heartbeat_that_may_be_retained_shows_its_robot_once_another_follows() -> None:
    present = PresentRobots()
    for payload in (b"1", b"1"):
        present.note_copy(GOOB, payload, 0.0)
    assert present.robots(0.0) == ()
    present.note_copy(GOOB, b"2", 0.0)
    assert present.robots(0.0) == (GOOB,)


def test_a_successor_takes_what_the_robot_retains_now() -> None:
    world = World("a", "b")
    world.run(4)
    (owner,) = (name for name, one in world.running.items() if GOOB in one.gateway.carries)
    world.robots[0].publish("outgoing/status", b'{"n": 1}', retain=True)
    world.run(0.2)
    world.running[owner].hang()
    world.robots[0].publish("outgoing/status", b'{"n": 2}', retain=True)
    world.run(4)
    world.running[owner].go_on()
    world.run(4)
    assert world.operators[0].payloads("outgoing/status")[:2] == [b'{"n": 1}', b'{"n": 2}']
    assert world.broker.retained[f"{GOOB}/outgoing/status"].payload == b'{"n": 2}'
    assert world.wrong() == 0


def test_the_will_of_a_robot_that_was_silent_before_reaches_the_broker(alone: World) -> None:
    alone.silent.add(GOOB)
    alone.run(4, sending=False)
    assert alone.running["a"].gateway.carries == frozenset()
    alone.robots[0].publish("outgoing/online", b'{"t": 0, "online": false}', retain=True)
    alone.run(2 * TAKING_S, sending=False)
    assert alone.broker.retained[ONLINE.topic(GOOB)].payload == b'{"t": 0, "online": false}'


@pytest.mark.parametrize(
    ("topic", "payload", "retain", "passes"),
    [
        ("incoming/lights-solid", b'{"r": 1}', False, True),
        ("incoming/lights-solid", b'{"r": 1}', True, False),
        ("incoming/by/ann/drive-values", b'{"x": 0.1, "z": 0}', False, True),
        ("incoming/by/ann/drive-values", b'{"x": 0.1, "z": 0}', True, False),
        ("incoming/by/ann/flags/mqtt-video", b"true", False, True),
        ("incoming/flags/reboot", b"true", False, True),
        ("incoming/estop", b'{"stop": "s1"}', False, True),
        ("incoming/by/ann/estop", b'{"stop": "s1"}', False, True),
        ("incoming/drive-values", b'{"x": 1, "z": 0, "source": "autonomy", "run": 1}', False, False),
        ("outgoing/status", b"{}", False, False),
    ],
)
def test_what_passes_to_a_robot(alone: World, topic: str, payload: bytes, retain: bool, passes: bool) -> None:
    alone.operators[0].publish(topic, payload, retain=retain)
    alone.run(0.2, sending=False)
    assert (payload in alone.robots[0].payloads(topic)) is passes
    assert not any(one.retain or one.retain_requested for one in alone.robots[0].on(topic))


def test_commands_of_the_hub_and_what_runs_there_do_not_reach_the_broker(alone: World) -> None:
    for topic in ("incoming/lights-solid", "incoming/estop", "incoming/flags/reboot"):
        alone.robots[0].publish(topic, b'{"hub": 1}')
    alone.run(0.2, sending=False)
    assert [one.topic for one in alone.operators[0].seen if b"hub" in one.payload] == []


def test_pictures_pass_while_they_are_allowed_until_an_operator_ends_them(alone: World) -> None:
    (robot,), (operator,) = alone.robots, alone.operators

    def passes() -> bool:
        before = len(operator.on("outgoing/front-camera"))
        robot.publish("outgoing/front-camera", b"picture", qos=0)
        alone.run(0.1, sending=False)
        return len(operator.on("outgoing/front-camera")) > before

    assert not passes(), "the flag is not known"
    operator.publish("incoming/flags/mqtt-video", b"true", retain=True)
    alone.run(0.1)
    assert passes(), "it is not known who has requested them"
    operator.publish("incoming/front-camera", b'{"enabled": false}')
    alone.run(0.1)
    assert not passes()
    operator.publish("incoming/front-camera", b'{"enabled": true}')
    alone.run(0.1)
    assert passes()
    operator.publish("incoming/flags/mqtt-video", b"false", retain=True)
    alone.run(0.1)
    assert not passes()


def test_every_gateway_forwards_a_live_stop_in_every_state() -> None:
    world = World("a", "b")
    stop = b'{"stop": "s%d"}'
    for number, seconds in enumerate((STEP_S, 0.5, 2.0)):  # not heard; taking; carried
        world.run(seconds)
        world.operators[0].publish("incoming/estop", stop % number)
        world.rest()
        assert world.robots[0].payloads("incoming/estop").count(stop % number) >= 2
    world.operators[0].publish("incoming/estop", stop % 9, retain=True)
    world.run(0.1)
    before = len(world.robots[0].on("incoming/estop"))
    late = world.running["late"] = Running(world, "late")
    world.run(3)
    assert late.gateway.counters["stops"] == 0, "a retained one is old"
    assert len(world.robots[0].on("incoming/estop")) == before


def test_what_one_robot_is_sent_holds_up_no_other() -> None:
    """A connection on which stops wait does not, nor does a flood of commands or stops."""
    world = World("a", robots=(GOOB, "pebble/robots/fred"))
    world.run(3)
    world.running["a"].stops.hold()
    for number in range(3 * MOST_TOGETHER):
        world.operators[0].publish(f"incoming/lights-{'solid' if number % 2 else 'flash'}", b"%d" % number)
        world.operators[0].publish("incoming/front-camera", b"%d" % number)
    world.run(3)
    lights = world.robots[0].payloads("incoming/lights-solid")
    assert len(lights) <= MOST_EACH + 1
    assert lights[-1] == b"%d" % (3 * MOST_TOGETHER - 1), "the last one passes"
    assert len(world.robots[0].payloads("incoming/front-camera")) <= MOST_EACH + 1
    assert world.all_pass()
    assert world.running["a"].gateway.counters["too_often"] > MOST_TOGETHER
    world.running["a"].stops.let_go()
    for number in range(2 * MOST_STOPS):
        world.operators[0].publish("incoming/estop", b'{"stop": "x%d"}' % number)
        for base in range(3):
            world.operators[0].transport.publish(f"pebble/robots/x{number}{base}/incoming/estop", b"")
    world.operators[1].publish("incoming/estop", b'{"stop": "fred"}')
    world.rest()
    assert b'{"stop": "fred"}' in world.robots[1].payloads("incoming/estop")


def test_a_robot_that_takes_long_to_begin_costs_the_gateway_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it does where a driver has left thousands of retained messages; heartbeats have a thread meanwhile."""
    world = World("a", robots=(GOOB, "pebble/robots/fred"))
    world.silent.add("pebble/robots/fred")
    world.run(3)
    gateway, begin = world.running["a"].gateway, module.begin

    def slow(robots: Sequence[Carried], hub: Transport, broker: Transport) -> list[Carried]:
        for _ in range(int(0.7 * module.STANDS_S / STEP_S)):
            world.now += STEP_S
            for robot in world.robots:
                robot.publish("outgoing/online", b'{"t": 0}', retain=True)
            gateway.publish_heartbeat()
            world.rest()
        return begin(robots, hub, broker)

    monkeypatch.setattr(module, "begin", slow)
    since = gateway.ownership.since(GOOB, world.now)
    world.silent.clear()
    world.run(4)
    assert gateway.carries == {GOOB, "pebble/robots/fred"}
    assert gateway.ownership.since(GOOB, world.now) == since


def test_a_gateway_whose_turns_do_not_end_loses_its_robots() -> None:
    world = World("a", "b", robots=(GOOB, "pebble/robots/fred"))
    world.run(4)
    (name,) = (name for name, one in world.running.items() if GOOB in one.gateway.carries)
    (other,) = world.running.keys() - {name}
    world.running[name].stands = True
    world.run(0.9 * module.STANDS_S)
    assert world.all_pass(), "its threads that receive carry them still"
    world.run(0.1 * module.STANDS_S + FRESH_S + TAKING_S)
    assert world.running[other].gateway.carries == {GOOB, "pebble/robots/fred"}
    assert world.all_pass()
    world.running[name].stands = False
    world.run(RECOVERY_S)
    assert GOOB in world.running[name].gateway.carries
    assert world.wrong() == 0
    assert world.all_pass()


def test_robots_begin_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits for hub and broker, and a gateway may take hundreds from one that has died."""
    robots = tuple(f"pebble/robots/r{number}" for number in range(5 * module.TOGETHER))
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


@pytest.mark.parametrize("stood_s", [0.0, 2 * FRESH_S])
def test_what_it_has_in_hand_while_it_stands_still_does_not_leave(
    monkeypatch: pytest.MonkeyPatch, alone: World, stood_s: float
) -> None:
    """It passed when it came; another gateway may have carried the robot since."""
    carried = alone.running["a"].gateway.carried(GOOB)
    assert carried is not None
    forwarder = carried.forwarder
    receive = forwarder.receive

    def stand_still(side: Side, message: Message) -> None:
        alone.now += stood_s
        receive(side, message)

    monkeypatch.setattr(forwarder, "receive", stand_still)
    alone.robots[0].publish("outgoing/counted", b"-1")
    alone.rest()
    assert (b"-1" in alone.operators[0].payloads("outgoing/counted")) is (stood_s == 0)


def test_of_two_with_one_name_one_rests() -> None:
    world = World("a")
    world.run(3)
    world.running["a again"] = Running(world, "a")
    world.run(8)
    assert sorted(len(one.gateway.carries) for one in world.running.values()) == [0, 1]
    assert world.wrong() == 0


@pytest.mark.parametrize("seed", range(cases(4, 200)))
def test_nothing_comes_twice_or_out_of_order_whatever_fails(seed: int) -> None:
    chance, names = random.Random(seed), ("a", "b", "c")[: 2 + seed % 2]
    world = World(*names, robots=(GOOB, "pebble/robots/fred"))
    world.run(4)
    for _ in range(10):
        name = chance.choice(names)
        one = world.running.get(name)
        if one is None:
            world.running[name] = Running(world, name)
        else:
            faults: list[Callable[[], object]] = [
                lambda name=name: world.kill(name),  # type: ignore[misc]
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
    for name in names:
        one = world.running.setdefault(name, Running(world, name)) if name not in world.running else world.running[name]
        for each in one.connections:
            each.mend()
        one.go_on()
    world.run(RECOVERY_S)
    assert world.wrong() == 0
    assert world.all_pass()
