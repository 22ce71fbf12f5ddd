"""Retained messages that a broker sends for exact names only are asked for, in virtual time and however many ask."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable

import pytest

from pebble.contract import CHARGING_LEVEL, DRIVE, ESTOP_STATE, ONLINE, STATUS
from pebble.runtime.by_name import EACH_S, MAX_ROBOTS, ByName
from pebble.transports import Message
from tests.client.estop_robot import Robot
from tests.support import cases, further

GOOB = "pebble/robots/goob"
ROBOT = Robot(GOOB, "left", "right")
CAPABILITIES, STATES = ROBOT.capabilities(), [owner.state(retain=True) for owner in ROBOT.owners]
ALL = [f"{GOOB}/outgoing/{metric}" for metric in ("capabilities", "status", "charging-level")]
OWNERS = [f"{GOOB}/outgoing/estop/{owner}" for owner in ("left", "right")]
Arriving = Iterable[tuple[float, Message]]


def heartbeat(base: str = GOOB, *, retain: bool = False, metric: str = "online") -> Message:
    return Message(f"{base}/outgoing/{metric}", json.dumps({"t": 1, "online": True}).encode(), retain=retain)


def heartbeats(base: str = GOOB, first: float = 0.0, last: float = 600.0, every_s: float = 0.25) -> Arriving:
    return [(first + every_s * n, heartbeat(base)) for n in range(int((last - first) / every_s))]


class Asked:
    """What is asked for when; ``answers``: what the broker sends for a topic."""

    def __init__(self, answers: Iterable[Message] = (), is_known: Callable[[str], bool] = lambda _: False) -> None:
        self.by_name = ByName([STATUS, ONLINE, CHARGING_LEVEL, ESTOP_STATE, DRIVE], is_known)
        self.asks: list[tuple[float, list[str]]] = []
        self._answers = {message.topic: message for message in answers}

    def run(self, arriving: Arriving, until: float, since: float = 0.0) -> None:
        waiting = sorted(arriving, key=lambda one: one[0])[::-1]
        for turn in range(int(since / EACH_S), int(until / EACH_S)):
            now = turn * EACH_S
            while waiting and waiting[-1][0] <= now:
                self.by_name.receive(waiting.pop()[1], now)
            if topics := self.by_name.take(now):
                self.asks.append((now, topics))
                for answer in [self._answers[topic] for topic in topics if topic in self._answers]:
                    self.by_name.receive(answer, now)

    def of(self, base: str) -> list[float]:
        return [round(at, 1) for at, topics in self.asks if topics[0].startswith(f"{base}/")]


#: What arrives by itself, what the broker has under exact names, and what is asked for when.
CASES: dict[str, tuple[Arriving, list[Message], list[tuple[float, list[str]]]]] = {
    "only for exact names": (heartbeats(), [CAPABILITIES, *STATES], [(1.0, ALL), (1.1, OWNERS)]),
    "for wildcards too": ([(0.0, one) for one in (CAPABILITIES, *STATES)] + list(heartbeats()), [], []),
    "late copies": ([(0.9, one) for one in (CAPABILITIES, *STATES)] + list(heartbeats()), [], []),
    "very late copies": ([(3.0, one) for one in (CAPABILITIES, *STATES)] + list(heartbeats()), [], [(1.0, ALL)]),
    "live capabilities": ([*heartbeats(), (0.5, CAPABILITIES)], STATES, []),
    "capabilities after the first time": (
        [*heartbeats(), (3.0, CAPABILITIES), (3.0, STATES[0])],
        STATES,
        [(1.0, ALL), (3.0, OWNERS[1:])],
    ),
    "it has none": (heartbeats(), [], [(1.0, ALL), (6.0, ALL), (36.0, ALL)]),
    "it appears later": (heartbeats(first=100.0), [CAPABILITIES, *STATES], [(101.0, ALL), (101.1, OWNERS)]),
    "one heartbeat": ([(0.0, heartbeat())], [CAPABILITIES, *STATES], [(1.0, ALL), (1.1, OWNERS)]),
    "an older name of it": (
        [(0.0, heartbeat(metric="heartbeat"))],
        [CAPABILITIES, *STATES],
        [(1.0, ALL), (1.1, OWNERS)],
    ),
    "it sends one a minute": (
        [(60.0 * n, heartbeat()) for n in range(9)],
        [CAPABILITIES, *STATES],
        [(1.0, ALL), (1.1, OWNERS)],
    ),
    "a retained heartbeat": ([(0.0, heartbeat(retain=True))], [CAPABILITIES], []),
    "an empty one": ([(0.0, Message(f"{GOOB}/outgoing/online", b""))], [CAPABILITIES], []),
    "a command": ([(0.0, Message(f"{GOOB}/incoming/online", b"{}"))], [CAPABILITIES], []),
    "a server": ([(0.0, heartbeat("pebble/servers/hall"))], [], []),
    "retained, but it is off": ([(0.0, CAPABILITIES)], STATES, []),
    "its capabilities are damaged": (
        heartbeats(),
        [Message(CAPABILITIES.topic, b"{", retain=True)],
        [(1.0, ALL), (6.0, ALL), (36.0, ALL)],
    ),
}


@pytest.mark.parametrize(("arriving", "answers", "expected"), CASES.values(), ids=CASES)
def test_a_robot_is_asked_for_what_does_not_come_by_itself(
    arriving: Arriving, answers: list[Message], expected: list[tuple[float, list[str]]]
) -> None:
    robots = Asked(answers)
    robots.run(arriving, 200)
    assert [(round(at, 1), topics) for at, topics in robots.asks] == expected


def test_what_came_before_an_outage_is_asked_for_again() -> None:
    robots = Asked([CAPABILITIES, *STATES])
    robots.run(heartbeats(), 100)
    robots.by_name.reset()
    robots.run(heartbeats(first=120), 200, since=110)
    assert robots.of(GOOB) == [1.0, 1.1, 121.0, 121.1]


LONG_S = cases(30, 100)


def flood(count: int, *, lasting: bool, last: float = LONG_S) -> Arriving:
    for n in range(count):
        yield from (
            heartbeats(f"evil/robots/e{n}", 0.001, last, 1.0) if lasting else [(0.001, heartbeat(f"evil/robots/e{n}"))]
        )


@pytest.mark.parametrize(
    ("invented", "known", "within_s"),
    [
        further(flood(1000, lasting=False), False, 2.0),
        (flood(5 * MAX_ROBOTS, lasting=False), False, 5.0),
        further(flood(1000, lasting=True), True, 2.0),
        further(flood(1000, lasting=True), False, 60.0),
        (flood(1000, lasting=True, last=4.0), False, 7.0),
        (flood(MAX_ROBOTS + 500, lasting=True, last=10.0), True, 2.0),
    ],
    ids=["1,000", "more than there is room for", "that last", "and it is new", "that have ended", "the same, too many"],
)
def test_robots_that_are_invented_cause_no_flood_and_keep_none_waiting(
    invented: Arriving, known: bool, within_s: float
) -> None:
    robots = Asked([CAPABILITIES, *STATES], lambda base: known and base == GOOB)
    robots.run([*invented, *heartbeats(first=0.3, last=LONG_S)], LONG_S)
    assert robots.of(GOOB)[0] <= within_s
    assert len(robots.of(GOOB)) == 2
    assert len(robots.asks) <= LONG_S / EACH_S
    assert max(len(robots.of(f"evil/robots/e{n}")) for n in range(0, 1000, 50)) <= 3
