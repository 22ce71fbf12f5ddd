"""What leaves a robot over a thin link: random walks that keep the rules of the sieve, and bugs that they find."""

from __future__ import annotations

import random
from collections import Counter, deque
from math import inf

import pytest

from pebble.contract import Kind
from pebble.extensions.thin import sieve as module
from pebble.extensions.thin.sieve import Rank, Sieve
from pebble.forwarding.routing import Forward
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, QoS
from pebble.transports.counters import Counters
from tests.support import cases

STATE, STREAM, EVENT = (Subject(kind) for kind in (Kind.STATE, Kind.STREAM, Kind.EVENT))
TOPICS = {f"{subject.kind.name}/{number}": subject for subject in (STATE, STREAM) for number in range(4)}
SIZES = (20, 20, 150, 700)
ROOM, DRAINS, TURN_S, STEP_S = 300, 60, 1.0, 0.1
WAITS_S, NEXT_S = 15.0, 1.5  # for all that can wait before a message, when it is overdue; for what is on its way
EVENTS, GONE = 20, 0.02  # that wait, and how often they are dropped
FORWARD = Forward(QoS.DELIVERED, False, False)


class Walk:
    """A sieve, its topics and a link that carries a little at each step. Each message has a number."""

    def __init__(self, seed: int, *, fair: bool) -> None:
        self.chance, self.fair = random.Random(seed), fair
        self.counters, self.counts = Counters(), Counter[str]()
        self.sieve = Sieve(self.takes, self.counters, lambda: self.now)
        self.sieve.stream_s = TURN_S
        self.now, self.ends = 100.0, False
        self.on_way = 0
        self.published = dict.fromkeys(TOPICS, 0)
        self.passed = dict.fromkeys(TOPICS, 0)
        self.passed_at = dict.fromkeys(TOPICS, 0.0)
        self.waits_since: dict[str, float] = {}
        self.events: deque[tuple[Message, float]] = deque()  # that wait, and since when each was the next one
        self.refused_since = inf
        self.weights = self.chance.choice([(1,) * 4 + (6,) * 4, (6,) * 4 + (1,) * 4])
        self.event_share, self.sizes = self.chance.choice([0.01, 0.1, 1.0]), self.chance.choice([SIZES, SIZES[:2]])

    def takes(self, rank: Rank, size: int) -> bool:
        fits = not self.on_way or self.on_way + min(size, ROOM) <= ROOM * rank
        self.on_way += size if fits else 0
        return fits

    def publish(self, topic: str) -> None:
        number = self.published[topic] = self.published[topic] + 1
        message = Message(topic, b"%d" % number + b" " * self.chance.choice(self.sizes), QoS.DELIVERED)
        self.counts["published"] += 1
        if self.sieve.keeps(TOPICS[topic], message, FORWARD):
            self.waits_since.setdefault(topic, self.now)
        else:
            self.passes(message)

    def passes(self, message: Message) -> None:
        topic, number = message.topic, int(message.payload)
        since = self.waits_since.pop(topic, self.now)
        assert number > self.passed[topic], "an older one follows a newer one"
        assert number == self.published[topic], "one that is not the newest"
        if self.fair:
            turn_s = TURN_S if TOPICS[topic] is STREAM and not self.ends else 0.0
            assert self.now - self.passed_at[topic] > turn_s - STEP_S / 2, "before its turn"
            assert all(before >= since for before in self.states_wait), "before a state that waits for longer"
            assert self.now - since < module.OVERDUE_S + WAITS_S, "it waited for too long"
        self.passed[topic], self.passed_at[topic] = number, self.now
        self.counts["passed"] += 1

    @property
    def states_wait(self) -> list[float]:
        return [since for topic, since in self.waits_since.items() if TOPICS[topic] is STATE]

    def step(self) -> None:
        for topic in self.chance.choices(list(TOPICS), weights=self.weights, k=self.chance.randrange(3)):
            self.publish(topic)
        if self.chance.random() < self.event_share and len(self.events) < EVENTS:
            self.events.append((Message("event", b" " * self.chance.choice(SIZES), QoS.DELIVERED), self.now))
        if self.chance.random() < GONE:
            self.events.clear()
        self.send()

    def send(self) -> None:
        self.now += STEP_S
        self.on_way = max(0, self.on_way - DRAINS)
        for one in self.sieve.due(Rank.STATE):
            self.passes(one.message)
        self.send_events()
        for one in self.sieve.due(Rank.STREAM):
            self.passes(one.message)
        assert len(self.sieve) <= module.TOPICS

    def send_events(self) -> None:
        while self.events:
            event, since = self.events[0]
            waited_s = self.now - since
            if not self.sieve.takes_event(event):
                assert waited_s < module.OVERDUE_S + NEXT_S, "an event waited for too long"
                self.refused_since = min(self.refused_since, self.now)
                return
            refused_s, self.refused_since = self.now - self.refused_since, inf
            assert not self.states_wait or not self.fair or refused_s > module.OVERDUE_S - STEP_S, "before a state"
            self.events.popleft()
            self.events = deque((one, self.now) for one, _ in self.events)

    def end(self, *, at_once: bool) -> None:
        """All that waits is sent: the link carries it, or it is wide again."""
        self.ends = at_once
        for one in self.sieve.take_all() if at_once else ():
            self.waits_since = {one.message.topic: self.now}
            self.passes(one.message)
        for _ in range(0 if at_once else 300):
            self.send()
        lost = {topic for topic, number in self.published.items() if self.passed[topic] < number}
        assert not {topic for topic in lost if TOPICS[topic] is STATE or self.fair}, "the newest is lost"
        counted = self.counts["passed"] + self.counters["thinned"] + self.counters["shed"]
        assert counted == self.counts["published"], "one is not counted"


def perform(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sieve with places for all topics, or for three of them; then what waits is sent, in one of two ways."""
    fair = seed % 3 > 0
    monkeypatch.setattr(module, "TOPICS", 512 if fair else 3)
    walk = Walk(seed, fair=fair)
    for _ in range(400):
        walk.step()
    walk.end(at_once=seed % 2 > 0)


@pytest.mark.parametrize("seed", range(cases(12, 1000)))
def test_no_walk_violates_a_rule(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    perform(seed, monkeypatch)
