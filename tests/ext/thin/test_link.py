"""The level of a link, by tables of what is measured; and random walks that keep the rules of the sieve behind it."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Iterable
from itertools import pairwise
from math import inf

import pytest

from pebble.contract import Kind
from pebble.contract.payloads import LinkLevel
from pebble.extensions.thin import sieve as module
from pebble.extensions.thin.link import LinkMeter, Room
from pebble.extensions.thin.sieve import Rank, Sieve
from pebble.forwarding.routing import Forward
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, QoS
from pebble.transports.counters import Counters
from tests.support import cases

PING_S = 0.5


class Walk:
    """A meter that is told round trips, in seconds, at every ping; notes when its level changed."""

    def __init__(self, profile: str = "auto", kbit: float | None = None) -> None:
        self.meter = LinkMeter(profile, kbit)
        self.now = 1000.0
        self.changes: list[tuple[float, LinkLevel]] = [(self.now, self.meter.level)]

    def take(self, trips: Iterable[float], tcp_queue_s: float | None = None) -> Walk:
        for trip in trips:
            self.now += PING_S
            self.meter.answered(trip, self.now, tcp_queue_s)
            if self.meter.level != self.changes[-1][1]:
                self.changes.append((self.now, self.meter.level))
        return self

    def read(self, history: str) -> Walk:
        """Words like ``600x30``: a round trip of so many ms, for so many seconds; ``lost``: the connection is."""
        for word in history.split():
            if word == "lost":
                self.meter.lost()
            else:
                trip_ms, seconds = map(float, word.split("x"))
                self.take([trip_ms / 1000] * round(seconds / PING_S))
        return self

    @property
    def levels(self) -> str:
        return " ".join(level for _, level in self.changes)


@pytest.mark.parametrize(
    ("history", "levels"),
    [
        ("20x30", "wide"),
        ("600x30", "wide"),  # far away is not narrow
        ("600x5 740x60", "wide"),
        ("20x5 400x0.5 20x60", "wide"),  # one late answer of three
        ("20x5 200x1", "wide narrow"),
        ("20x5 200x0.5 20x0.5 200x0.5", "wide narrow"),  # two of three
        ("20x5 200x0.5 20x1 200x0.5 20x9", "wide"),
        ("20x5 200x30", "wide narrow"),  # not worse than 300 ms
        ("20x5 400x1", "wide narrow"),  # each level has its turn
        ("20x5 400x2", "wide narrow thin"),
        ("20x5 400x660", "wide narrow thin"),  # a queue that stays
        ("20x5 400x725", "wide narrow thin narrow"),  # becomes the norm after ten minutes, to the minute
        ("20x5 200x1 20x20", "wide narrow"),
        ("20x5 200x1 20x20.5", "wide narrow wide"),
        ("20x5 200x1 20x15 80x0.5 20x15", "wide narrow"),  # without a queue from then on only
        ("20x5 200x1 20x15 lost 20x15", "wide narrow"),
        ("20x5 400x2 20x60.5", "wide narrow thin narrow"),
        ("20x5 400x2 20x81", "wide narrow thin narrow wide"),
        ("20x5 400x0.5 lost 400x0.5", "wide"),  # of two connections
        ("20x5 200x1 20x20.5 200x1 20x39", "wide narrow wide narrow"),  # a rise has failed: twice the time
        ("20x5 200x1 20x20.5 200x1 20x41", "wide narrow wide narrow wide"),
        ("20x5 200x1 20x100 200x1 20x20.5", "wide narrow wide narrow wide"),  # that one had not
    ],
)
def test_histories(history: str, levels: str) -> None:
    assert Walk().read(history).levels == levels


@pytest.mark.parametrize(
    ("profile", "kbit", "levels"),
    [
        ("wide", None, "wide"),
        ("thin", None, "thin"),
        ("thin", 500.0, "thin"),
        ("auto", 31.0, "thin"),  # carries no commands of a wide link, whatever is measured
        ("auto", 32.0, "wide narrow thin narrow wide"),
    ],
)
def test_profiles(profile: str, kbit: float | None, levels: str) -> None:
    assert Walk(profile, kbit).read("20x5 400x2 20x90").levels == levels


@pytest.mark.parametrize(
    ("history", "stands"),
    [
        ("600x30", False),
        ("600x5 1000x1.5", False),  # one answer is late, perhaps by a loss
        ("600x5 1000x1 600x0.5 1000x1", False),
        ("600x5 880x60", False),  # not longer than 300 ms
        ("600x5 1000x2", True),
        ("600x5 1000x2 750x60", True),  # it has not drained
        ("600x5 1000x2 620x5", True),
        ("600x5 1000x2 620x3 750x0.5 620x3", True),
        ("600x5 1000x2 620x5.5", False),
        ("600x5 1000x2 620x5.5 1000x1.5", False),
        ("600x5 1000x2 lost", False),
        ("600x5 1000x1 lost 1000x1", False),
    ],
)
def test_a_queue_stands(history: str, stands: bool) -> None:
    assert Walk("thin").read(history).meter.crowded is stands


def test_the_state_shows_what_is_measured() -> None:
    walk = Walk("thin").read("620x60 600x0.5 950x0.5")
    assert (round(walk.meter.round_trip_s, 3), round(walk.meter.queue_s, 3)) == (0.6, 0.35)
    walk.read("950x661")  # the shortest one is forgotten after ten minutes, to the minute
    assert (round(walk.meter.round_trip_s, 3), walk.meter.queue_s) == (0.95, 0.0)


def test_losses_alone_lower_nothing() -> None:
    """What was lost and sent again delays answers; TCP's own round trips leave that out."""
    chance = random.Random(1)
    late = (chance.random() < 0.3 for _ in range(100_000))
    assert Walk().take((0.05 + chance.random() * 3 * one for one in late), tcp_queue_s=0.04).levels == "wide"


def test_a_link_that_fails_each_time_changes_ever_more_rarely() -> None:
    walk = Walk().read("20x5")
    while walk.now < 1000.0 + 4 * 3600:
        walk.read("200x1" if walk.meter.level == "wide" else "20x1")
    rises = [at for at, level in walk.changes[1:] if level == "wide"]
    gaps = [round(later - earlier) for earlier, later in pairwise(rises)]
    assert gaps[:6] == [42, 82, 162, 322, 602, 602]
    assert set(gaps[5:]) == {602}


class TestRoom:
    def test_of_a_known_link_is_what_drains_soon(self) -> None:
        room = Room(kbit=9.6)
        room.poll(0, 0.6, 0.0)
        assert [room.takes(Rank.STREAM, 200, 0.0) for _ in range(4)] == [True, True, True, False]
        assert [room.takes(Rank.STATE, 200, 0.0) for _ in range(4)] == [True, True, True, False]
        assert room.takes(Rank.HEARTBEAT, 200, 0.0)

    def test_is_learned(self) -> None:
        """It grows while what is sent is confirmed without delay, and shrinks when it is not."""
        room, now = Room(), 0.0
        sizes = []
        for round_trip_s in (0.1, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 0.5, 0.5):
            sent = 0
            while room.takes(Rank.STREAM, 100, now):
                sent += 1
            sizes.append(sent)
            now += round_trip_s
            room.poll(0, 0.1, now)
        assert sizes == [15, 30, 60, 120, 240, 168, 117, 82, 57]

    def test_does_not_grow_while_little_is_sent(self) -> None:
        room = Room()
        for number in range(100):
            assert room.takes(Rank.STREAM, 100, number / 10)
            room.poll(0, 0.1, number / 10 + 0.1)
        assert sum(room.takes(Rank.STREAM, 100, 10.0) for _ in range(100)) == 15

    def test_one_message_is_always_on_its_way(self) -> None:
        room = Room(kbit=1.0)
        assert room.takes(Rank.STREAM, 5000, 0.0)
        assert not room.takes(Rank.HEARTBEAT, 1, 0.0)
        room.poll(0, 0.1, 40.0)
        assert room.takes(Rank.STREAM, 5000, 40.0)


# -- the sieve


STATE, STREAM, EVENT = (Subject(kind) for kind in (Kind.STATE, Kind.STREAM, Kind.EVENT))
TOPICS = {f"{subject.kind.name}/{number}": subject for subject in (STATE, STREAM) for number in range(4)}
SIZES = (20, 20, 150, 700)
ROOM, DRAINS, TURN_S, STEP_S = 300, 60, 1.0, 0.1
WAITS_S, NEXT_S = 15.0, 1.5  # for all that can wait before a message, when it is overdue; for what is on its way
EVENTS, GONE = 20, 0.02  # that wait, and how often they are dropped
FORWARD = Forward(QoS.DELIVERED, False, False)


class Passage:
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


@pytest.mark.parametrize("seed", range(cases(15, 1000)))
def test_no_walk_violates_a_rule(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sieve with places for all topics, or for three of them; then what waits is sent, in one of two ways."""
    fair = seed % 3 > 0
    monkeypatch.setattr(module, "TOPICS", 512 if fair else 3)
    walk = Passage(seed, fair=fair)
    for _ in range(400):
        walk.step()
    walk.end(at_once=seed % 2 > 0)
