"""The small parts that bridge and mirror are made of, without any connection."""

from __future__ import annotations

import pytest

from pebble.forwarding import echoes as echo_book
from pebble.forwarding.agreement import TOPICS, Agreement, Verdict
from pebble.forwarding.echoes import EXPIRY_S, Echoes
from pebble.forwarding.outage import DOUBT_S, EventBuffer
from pebble.forwarding.routing import Side
from pebble.transports import Message, QoS, State
from pebble.transports.counters import Counters
from pebble.transports.memory import MemoryHub, MemoryTransport

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class TestEchoes:
    def test_are_told_from_others_words(self) -> None:
        echoes = Echoes(Clock())
        for payload in (b"1", b"0", b"1"):
            echoes.expect("t", payload)
        assert [echoes.is_echo("t", payload) for payload in (b"1", b"2", b"0", b"1", b"1")] == [
            True, False, True, True, False,
        ]  # fmt: skip

    def test_topics_do_not_mix(self) -> None:
        echoes = Echoes(Clock())
        echoes.expect("t", b"1")
        assert not echoes.is_echo("u", b"1")

    def test_lost_ones_are_passed_over(self) -> None:
        echoes = Echoes(Clock())
        for payload in (b"1", b"0"):
            echoes.expect("t", payload)
        assert echoes.is_echo("t", b"0")
        assert not echoes.is_echo("t", b"1")

    def test_expire(self) -> None:
        clock = Clock()
        echoes = Echoes(clock)
        echoes.expect("t", b"1")
        clock.now += EXPIRY_S + 0.1
        assert not echoes.is_echo("t", b"1")

    def test_what_was_not_sent_does_not_come_back(self) -> None:
        echoes = Echoes(Clock())
        echoes.expect("t", b"1")
        echoes.forget("t")
        assert not echoes.is_echo("t", b"1")

    def test_many_topics_take_no_memory(self) -> None:
        echoes = Echoes(Clock())
        for number in range(2 * echo_book.TOPICS):
            echoes.expect(f"flag{number}", b"1")
        assert len(echoes) == echo_book.TOPICS
        assert all(echoes.is_echo(f"flag{number}", b"1") for number in range(echo_book.TOPICS, 2 * echo_book.TOPICS))
        assert len(echoes) == 0


class TestAgreement:
    """Table: what each side says, in order, and the verdicts. The remote side is the winner, as on the bridge."""

    @pytest.mark.parametrize(
        ("history", "verdicts"),
        [
            ("L:a", ["hold"]),
            ("R:b L:a", ["pass", "retell"]),
            ("R:a L:a", ["pass", "known"]),
            ("L:a R:b", ["hold", "pass"]),
            ("l:a R:a", ["pass", "known"]),
            ("l:a R:b", ["pass", "pass"]),
            ("l:a l:a", ["pass", "pass"]),
            ("r:a l:b r:a", ["pass", "pass", "pass"]),
            ("settle L:a", ["pass"]),
            ("r:a l:b L:c", ["pass", "pass", "pass"]),
            ("R:a x:b R:a", ["pass", "pass", "overtaken"]),
            ("R:a x:b settle R:a", ["pass", "pass", "pass"]),
            ("R:a x:b r:c R:d", ["pass", "pass", "pass", "pass"]),
        ],
    )
    def test_verdicts(self, history: str, verdicts: list[str]) -> None:
        """L, R: found as a kept copy. l, r: said while we look. x: said locally while the remote side was away."""
        agreement = Agreement(REMOTE)
        given = []
        for word in history.split():
            if word == "settle":
                agreement.settle(REMOTE)
                continue
            who, _, payload = word.partition(":")
            side = REMOTE if who in "Rr" else LOCAL
            verdict = agreement.hear(side, "t", payload.encode(), kept=who.isupper(), other_away=who == "x")
            given.append(verdict)
        assert given == [Verdict[name.upper()] for name in verdicts]

    def test_held_copies_fill_what_the_winner_does_not_know(self) -> None:
        agreement = Agreement(REMOTE)
        agreement.hear(LOCAL, "known", b"local", kept=True)
        agreement.hear(LOCAL, "unknown", b"local", kept=True)
        agreement.hear(REMOTE, "known", b"remote", kept=True)
        agreement.tell(LOCAL, "known", b"remote")
        assert agreement.settle(REMOTE) == [(REMOTE, "unknown", b"local")]
        assert agreement.value("unknown") == b"local"
        assert agreement.settle(LOCAL) == []

    def test_a_side_that_forgot_is_told(self) -> None:
        agreement = Agreement(REMOTE)
        agreement.hear(REMOTE, "t", b"new", kept=False)
        agreement.begin(REMOTE)
        assert agreement.settle(REMOTE) == [(REMOTE, "t", b"new")]
        agreement.begin(REMOTE)
        agreement.hear(REMOTE, "t", b"new", kept=True)
        assert agreement.settle(REMOTE) == []

    def test_a_removed_topic_is_not_brought_back(self) -> None:
        agreement = Agreement(REMOTE)
        agreement.hear(LOCAL, "t", b"a", kept=False)
        agreement.hear(LOCAL, "t", b"", kept=False)
        agreement.begin(REMOTE)
        assert agreement.settle(REMOTE) == []

    def test_its_memory_is_bounded(self) -> None:
        agreement = Agreement(REMOTE)
        for number in range(2 * TOPICS):
            agreement.hear(LOCAL, f"held/{number}", b"x", kept=True)
            agreement.hear(REMOTE, f"said/{number}", b"x", kept=False)
            agreement.tell(LOCAL, f"said/{number}", b"x")
        assert len(agreement.settle(REMOTE)) <= 2 * TOPICS
        assert len(agreement._last) <= TOPICS
        assert all(len(told) <= TOPICS for told in agreement._told.values())


class Wire(MemoryTransport):
    """Takes what it is given while it is up, and remembers it."""

    def __init__(self) -> None:
        super().__init__("wire", MemoryHub())
        self.up = True
        self.sent: list[bytes] = []

    @property
    def state(self) -> State:
        return State.CONNECTED if self.up else State.CONNECTING

    def publish(
        self, topic: str, payload: bytes, *, qos: QoS = QoS.LATEST, retain: bool = False, urgent: bool = False
    ) -> bool:
        self.sent += [payload] if self.up else []
        return self.up


class TestEventBuffer:
    @pytest.fixture
    def wire(self) -> Wire:
        return Wire()

    @pytest.fixture
    def clock(self) -> Clock:
        return Clock()

    @pytest.fixture
    def events(self, wire: Wire, clock: Clock) -> EventBuffer:
        return EventBuffer(wire, Counters(), clock=clock, limit=4)

    def say(self, events: EventBuffer, *numbers: int) -> None:
        for number in numbers:
            events.send(Message("t", b"%d" % number, QoS.DELIVERED))

    def test_passes_on_at_once_and_in_order(self, events: EventBuffer, wire: Wire) -> None:
        self.say(events, 1, 2, 3)
        assert wire.sent == [b"1", b"2", b"3"]

    def test_keeps_the_newest_of_an_outage(self, events: EventBuffer, wire: Wire) -> None:
        wire.up = False
        events.watch(State.CONNECTING)
        self.say(events, 1, 2, 3, 4, 5, 6)
        wire.up = True
        events.flush()
        assert wire.sent == [b"3", b"4", b"5", b"6"]
        assert events._counters["events_dropped"] == 2

    def test_repeats_what_a_dying_link_may_have_swallowed(self, events: EventBuffer, wire: Wire, clock: Clock) -> None:
        self.say(events, 1)
        clock.now += DOUBT_S
        self.say(events, 2)
        clock.now += DOUBT_S - 0.1
        wire.up = False
        events.watch(State.CONNECTING)
        clock.now += 60
        self.say(events, 3)
        wire.up = True
        self.say(events, 4)  # before the flush: waits its turn
        events.flush()
        assert wire.sent == [b"1", b"2", b"2", b"3", b"4"]

    def test_one_refused_in_between_is_sent_with_the_next(self, events: EventBuffer, wire: Wire) -> None:
        wire.up = False
        self.say(events, 1)
        wire.up = True
        self.say(events, 2)
        assert wire.sent == [b"1", b"2"]
