"""Brokers that hang up on a message cost its topic; links and brokers that fail for other reasons cost none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import pytest

from pebble.transports import Message
from pebble.transports.mqtt.outgoing import InFlightTable
from pebble.transports.mqtt.suspects import Kind, SuspectTopics
from tests.support import some

STEP_S = 0.02
VITAL = ("r/online", "r/capabilities", "r/estop/+")
#: Seconds between two messages of each topic, the bytes of one, and whether it is retained.
ROBOT = {
    "r/online": (0.25, 20, True),
    "r/estop/wheels": (30.0, 60, True),
    "r/capabilities": (1e9, 3000, True),
    "r/status": (5.0, 400, True),
    "r/charging": (5.0, 20, True),
    "r/touch": (0.02, 50, False),
    "r/imu": (0.2, 300, False),
    "r/rare": (20.0, 50, False),
}


class Broker(NamedTuple):
    """How the other end behaves: what it hangs up on, ``late_s`` after it has read that; and how the link does."""

    refuses: Callable[[str, int, float], bool] = lambda _topic, _size, _now: False
    late_s: float = 0.0
    loss_every_s: float = 1e9
    losses: int = 0  # of the link
    silent: bool = False  # and are these noticed by silence, not by FIN or RST?
    driven: bool = False  # commands arrive all the time
    round_trip_s: float = 0.02


class World:
    """One robot's connections to one broker, in virtual time."""

    def __init__(self, broker: Broker, **sizes: int) -> None:
        self.broker, self.now = broker, 0.0
        self.sizes = {topic: sizes.get(topic.rpartition("/")[2], size) for topic, (_, size, _) in ROBOT.items()}
        self.suspects = SuspectTopics(VITAL)
        self.assessments: list[tuple[Kind, list[str]]] = []
        self.arrived, self.freed = Counter[str](), list[str]()
        self.losses = 0
        self.lost_at: float | None = None
        self.link_losses = 0
        self.connect()

    def connect(self) -> None:
        self.in_flight, self.began = InFlightTable(), self.now
        self.pongs: list[float] = []
        self.ping_at, self.hang_up_at = self.now + 0.5, 1e9
        self.suspects.connected(self.now)
        self.doubtful = set(self.suspects.doubtful)
        self.connected = True
        for topic, (_, _, retained) in ROBOT.items():
            if retained:
                self.publish(topic)

    def publish(self, topic: str) -> None:
        message, arrived_at = Message(topic, bytes(self.sizes[topic])), self.now if self.broker.driven else -1e9
        if not self.suspects.accepts(message):
            if not self.suspects.tries(message, self.now, arrived_at):
                return
            self.doubtful.add(topic)
        self.in_flight.sent(message, 0, self.now)
        if self.hang_up_at > self.now + self.broker.round_trip_s:
            if self.broker.refuses(topic, len(message.payload), self.now):
                self.hang_up_at = min(self.hang_up_at, self.now + self.broker.round_trip_s + self.broker.late_s)
            else:
                self.arrived[topic] += 1
        if topic in self.doubtful:
            self.doubtful.discard(topic)
            self.ping()

    def ping(self) -> None:
        self.in_flight.ping(self.now, None)
        self.pongs.append(self.now + self.broker.round_trip_s)

    def lose(self, *, closed: bool = True) -> None:
        self.losses += 1
        assessment = self.suspects.lost(self.in_flight.first_written(self.now) if closed else None, self.now)
        if assessment is not None:
            self.assessments.append((assessment.kind, sorted(assessment.topics)))
        self.connected, self.lost_at = False, self.now

    def run(self, seconds: float) -> World:
        for step in range(round(self.now / STEP_S), round((self.now + seconds) / STEP_S)):
            self.now = step * STEP_S
            if not self.connected:
                assert self.lost_at is not None
                if self.now - self.lost_at >= 0.1:
                    self.connect()
                continue
            while self.pongs and self.pongs[0] <= self.now and self.pongs[0] < self.hang_up_at:
                self.pongs.pop(0)
                self.in_flight.pong(self.now)
            if self.now >= self.hang_up_at:
                self.lose()
                continue
            if self.now - self.began >= self.broker.loss_every_s and self.link_losses < self.broker.losses:
                self.link_losses += 1
                self.lose(closed=not self.broker.silent)
                continue
            confirmed = self.suspects.confirm(self.now, self.in_flight.has_accepted)
            if confirmed is not None and confirmed[1]:
                self.freed.append(confirmed[0].topic)
            for topic, (period_s, _, retained) in ROBOT.items():
                every = max(1, round(period_s / STEP_S))
                if step % every == every - 1 or (
                    retained and topic in self.suspects.due(self.now, self.now if self.broker.driven else -1e9)
                ):
                    self.publish(topic)
            if self.now >= self.ping_at:
                self.ping_at = self.now + 0.45
                self.ping()
        self.now = round(self.now + STEP_S, 2)
        return self

    def refused(self) -> set[str]:
        return {topic for kind, topics in self.assessments if kind is Kind.REFUSED for topic in topics}


def on(*topics: str) -> Callable[[str, int, float], bool]:
    return lambda topic, _size, _now: topic in topics


LINKS = [(0.0, 0.0, False), (0.0, 0.02, True), (0.0, 0.3, False), (0.2, 0.02, True), (0.7, 0.3, False)]
REFUSED = [("r/touch",), ("r/status",), ("r/rare",), ("r/touch", "r/status"), ("r/imu", "r/charging", "r/rare")]


@pytest.mark.parametrize(("link", "topics"), some(product(LINKS, REFUSED), 6))
def test_what_a_broker_hangs_up_on_costs_that_topic(link: tuple[float, float, bool], topics: tuple[str, ...]) -> None:
    late_s, round_trip_s, driven = link
    world = World(Broker(on(*topics), late_s=late_s, driven=driven, round_trip_s=round_trip_s)).run(400)
    assert world.refused() == set(topics)
    assert set(world.suspects.withheld) == set(topics)
    assert len([kind for kind, _ in world.assessments if kind is Kind.REFUSED]) == len(topics), "each is logged once"
    assert Kind.VITAL not in [kind for kind, _ in world.assessments]
    losses, before = world.losses, world.arrived.copy()
    world.run(120)
    assert world.losses - losses <= 3 * len(topics), "each is tried about once a minute"
    for topic in set(ROBOT) - set(topics) - {"r/rare", "r/capabilities", "r/estop/wheels"}:
        assert world.arrived[topic] - before[topic] >= 0.95 * 120 / ROBOT[topic][0] - 1


@pytest.mark.parametrize("driven", some([False, True], 2))
def test_a_topic_that_is_allowed_again_is_used_again(driven: bool) -> None:
    def refuses(topic: str, _size: int, now: float) -> bool:
        return topic == "r/touch" and now < 100

    world = World(Broker(refuses, driven=driven)).run(99)
    assert world.refused() == {"r/touch"}
    world.run(800 if driven else 70)
    assert world.freed == ["r/touch"]
    assert not world.suspects.withheld
    before = world.arrived["r/touch"]
    world.run(10)
    assert world.arrived["r/touch"] - before > 490


@pytest.mark.parametrize("topic", ["r/online", "r/estop/wheels", "r/capabilities"])
def test_a_vital_topic_is_never_withheld_and_the_error_names_it(topic: str) -> None:
    def refuses(one: str, _size: int, now: float) -> bool:
        return one == topic and now < 100

    world = World(Broker(refuses)).run(99)
    assert any(kind is Kind.VITAL and topic in topics for kind, topics in world.assessments)
    assert sum(kind is Kind.VITAL for kind, _ in world.assessments) <= 2
    assert not world.refused()
    world.run(60)
    assert not world.suspects.withheld
    assert min(world.arrived[one] for one in ROBOT if one != "r/rare") > 0


@pytest.mark.parametrize(
    ("topic", "size"), [("r/capabilities", 20_000), ("r/status", 20_000), ("r/imu", 24_000), ("r/touch", 1500)]
)
def test_a_message_beyond_the_limit_of_a_broker_costs_only_messages_of_that_size(topic: str, size: int) -> None:
    limit = 10_000 if size > 10_000 else 1000
    world = World(Broker(lambda _topic, size_, _now: size_ > limit), **{"capabilities": 900, topic[2:]: size}).run(60)
    assert world.refused() == {topic}
    world.sizes[topic] = size // 3
    before = world.arrived[topic]
    world.publish(topic)
    world.run(0.1)
    assert world.arrived[topic] > before
    losses = world.losses
    world.publish(topic)
    world.run(2)
    assert world.losses == losses
    world.sizes[topic] = size
    world.run(180)
    assert world.losses - losses <= 4


EVERY_S = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 10.02, 15.0)


@pytest.mark.parametrize(
    ("every_s", "silent", "driven", "round_trip_s"),
    some(product(EVERY_S, (False, True), (False, True), (0.02, 0.2)), 5),
)
def test_a_link_that_is_lost_20_times_costs_no_topic(
    every_s: float, silent: bool, driven: bool, round_trip_s: float
) -> None:
    broker = Broker(loss_every_s=every_s, losses=20, silent=silent, driven=driven, round_trip_s=round_trip_s)
    world = World(broker).run(21 * (every_s + 0.12))
    assert world.losses == 20
    world.run(20)
    assert not world.refused()
    assert every_s < round_trip_s or Kind.VITAL not in [kind for kind, _ in world.assessments]
    assert not world.suspects.withheld
    before = world.arrived["r/touch"]
    world.run(1)
    assert world.arrived["r/touch"] - before >= 49


def test_a_broker_that_hangs_up_for_another_reason_costs_no_topic() -> None:
    """Such as one with a quota of messages: it has accepted the topics before, on the same connection."""
    count = Counter[str]()

    def refuses(_topic: str, _size: int, _now: float) -> bool:
        count["all"] += 1
        return count["all"] % 200 == 0

    world = World(Broker(refuses)).run(100)
    assert world.losses > 20
    assert world.assessments == []


def test_losses_while_a_topic_is_refused_do_not_free_it_and_those_while_one_is_suspected_do() -> None:
    world = World(Broker(on("r/touch"))).run(20)
    assert world.refused() == {"r/touch"}
    for _ in range(5):
        world.lose(closed=False)
        world.run(3)
    assert set(world.suspects.withheld) == {"r/touch"}
    flapping = World(Broker(on("r/imu"))).run(5)
    assert set(flapping.suspects.withheld) == {"r/imu"}
    flapping.lose(closed=False)
    assert not flapping.suspects.withheld
    flapping.run(60)
    assert flapping.refused() == {"r/imu"}


def test_what_is_remembered_is_bounded() -> None:
    suspects, in_flight = SuspectTopics(), InFlightTable()
    for number in range(5000):
        in_flight.sent(Message(f"t/{number}", b""), 0, 1.0)
    for _ in range(3):
        suspects.connected(1.0)
        assessment = suspects.lost(in_flight.first_written(1.1), 1.1)
    assert assessment is not None
    assert len(suspects.withheld) == len(assessment.topics) == 1000
    assert len(assessment.text("broker b")) < 300
