"""What waits to be sent, what is unconfirmed, how long what comes may have waited; filters and what they match."""

from __future__ import annotations

import itertools
import random
import tracemalloc

import pytest
import zenoh
from paho.mqtt.client import topic_matches_sub

from pebble.transports import Message, QoS
from pebble.transports.mqtt import filters
from pebble.transports.mqtt.filters import BrokerFilters, OwnMessageFilter, overlap
from pebble.transports.mqtt.outgoing import BACKLOG_BYTES, BACKLOG_MESSAGES, Backlog, InFlightTable, PendingAck
from pebble.transports.mqtt.read_age import BrokerDelay, WaitingTime
from pebble.transports.topics import matches
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic, topic_to_key
from tests.support import THOROUGH, cases, some


def drain(backlog: Backlog) -> list[bytes]:
    taken = []
    while backlog.waiting:
        taken.append(backlog.take().payload)
    return taken


def test_bytes_are_bounded_but_one_message_may_always_wait() -> None:
    backlog = Backlog()
    assert backlog.put(Message("a", b"1" * BACKLOG_BYTES * 3)) == 0
    assert backlog.put(Message("a", b"2" * (BACKLOG_BYTES - 1))) == 1
    assert backlog.put(Message("a", b"3")) == 0
    assert [payload[:1] for payload in drain(backlog)] == [b"2", b"3"]


def test_a_retained_message_is_replaced_only_by_a_newer_one_of_its_topic() -> None:
    backlog = Backlog()
    backlog.put(Message("state", b"old", retain=True))
    backlog.put(Message("other", b"other", retain=True))
    for _ in range(BACKLOG_MESSAGES * 2):
        backlog.put(Message("a", b"x"))
    assert backlog.put(Message("state", b"new", retain=True)) == 1
    taken = drain(backlog)
    assert taken[0] == b"other"
    assert taken[-1] == b"new"
    assert len(taken) == BACKLOG_MESSAGES + 2


def test_a_delivered_message_makes_what_waits_on_its_topic_stale() -> None:
    backlog = Backlog()
    for message in (Message("a", b"1"), Message("b", b"2"), Message("a", b"3", retain=True)):
        backlog.put(message)
    assert backlog.supersede(Message("a", b"4")) == 1
    assert backlog.supersede(Message("a", b"5", retain=True)) == 1
    assert drain(backlog) == [b"2"]
    assert not backlog.waiting


def retained(topic: str, payload: bytes = b"1", qos: QoS = QoS.DELIVERED) -> Message:
    return Message(topic, payload, qos, retain=True)


def send(in_flight: InFlightTable, message: Message, mid: int, now: float = 0.0) -> Message:
    in_flight.accept(message)
    in_flight.sent(message, mid, now)
    return message


def test_an_acknowledgement_proves_the_message_it_names() -> None:
    in_flight = InFlightTable()
    send(in_flight, Message("event", b"", QoS.DELIVERED), 1)
    send(in_flight, retained("a"), 2)
    newer = send(in_flight, retained("a", b"2"), 3)
    assert in_flight.unacked == 3
    assert in_flight.acknowledge(2, 0.0) is not None
    assert in_flight.unconfirmed_retained() == [newer]
    assert in_flight.acknowledge(3, 0.0) is not None
    assert in_flight.unconfirmed_retained() == []
    assert in_flight.acknowledge(3, 0.0) is None
    assert in_flight.unacked == 1


def test_messages_wait_since_the_newest_acknowledgement() -> None:
    in_flight = InFlightTable()
    assert in_flight.waiting_since is None
    send(in_flight, Message("stream", b"", QoS.LATEST), 1, 1.0)
    assert in_flight.waiting_since is None
    for mid, at in ((2, 2.0), (3, 2.1), (4, 2.2)):
        send(in_flight, Message("event", b"", QoS.DELIVERED), mid, at)
    assert in_flight.waiting_since == 2.0
    in_flight.acknowledge(3, 2.5)
    assert in_flight.waiting_since == 2.5, "the other one is lost; nothing stands still"
    in_flight.acknowledge(2, 2.6)
    in_flight.acknowledge(4, 2.7)
    assert in_flight.waiting_since is None
    send(in_flight, Message("event", b"", QoS.DELIVERED), 5, 9.0)
    assert in_flight.waiting_since == 9.0


def test_an_answered_ping_proves_what_was_sent_before_it() -> None:
    in_flight = InFlightTable()
    send(in_flight, retained("before", qos=QoS.LATEST), 1)
    in_flight.ping(0.0, None)
    after = send(in_flight, retained("after", qos=QoS.LATEST), 2)
    in_flight.accept(waiting := retained("waiting", qos=QoS.LATEST))
    in_flight.pong(0.1)
    assert in_flight.unconfirmed_retained() == [after, waiting]
    in_flight.ping(0.2, None)
    in_flight.pong(0.3)
    assert in_flight.unconfirmed_retained() == [waiting]


def test_answers_complete_their_request_only() -> None:
    in_flight, first, second, ping = InFlightTable(), PendingAck(), PendingAck(), PendingAck()
    in_flight.ask(1, first)
    in_flight.ask(2, second)
    in_flight.ping(0.0, ping)
    in_flight.answer(2)
    in_flight.answer(7)
    assert not second.is_set(), "not before what came before the answer has been delivered"
    in_flight.complete()
    assert (first.is_set(), second.is_set(), ping.is_set()) == (False, True, False)
    in_flight.pong(1.0)
    in_flight.complete()
    assert ping.is_set()
    in_flight.pong(1.0)  # one more than there were pings
    in_flight.end()
    assert first.is_set()


def test_a_topic_counts_as_accepted_once_the_ping_after_its_first_message_is_answered() -> None:
    """Also if others of its messages follow all the time; until then the loss of the connection may be its fault."""
    in_flight = InFlightTable()
    for number in range(4):
        send(in_flight, Message("stream", b""), 0, now := 5.0 + number / 10)
        in_flight.ping(now, None)
    send(in_flight, Message("rare", bytes(9)), 0, 5.4)
    assert in_flight.first_written(5.5) == {"stream": 0, "rare": 9}
    in_flight.pong(5.5)
    send(in_flight, Message("stream", bytes(200)), 0, 5.6)
    send(in_flight, Message("stream", bytes(9000)), 0, 5.7)
    assert in_flight.first_written(5.8)["stream"] == 9000, "the broker may accept no more than it has"
    for _ in range(3):
        in_flight.pong(5.8)
    in_flight.ping(5.8, None)
    in_flight.pong(5.9)
    assert in_flight.first_written(5.9) == {}


# -- since when received bytes may have waited in the kernel or at the broker


@pytest.mark.parametrize(
    "events",  # e: the socket was empty at that time; f: so many bytes were found then; r: so many were read; =: since
    [
        "e5 f5/100 =5",  # bytes that come into an empty socket have not waited
        "e5 f9/1000 =5",  # found after a stop, they may have waited since it was last empty
        "f9/1000 r400 =1 f9.1/2000 r400 =1 f9.2/2000 r400 =1 f9.3/2000 =9",  # batches; more comes meanwhile
        "f9/1000 r900 e9.1 f9.2/10 =9.1",
    ],
)
def test_since_when_bytes_have_waited(events: str) -> None:
    waiting = WaitingTime(1.0)
    for event in events.split():
        number, _, count = event[1:].partition("/")
        match event[0]:
            case "e":
                waiting.empty(float(number))
            case "f":
                waiting.found(int(count), float(number))
            case "r":
                waiting.read(int(number))
            case _:
                assert waiting.since == float(number), event


def delayed(usual_s: float = 0.1) -> BrokerDelay:
    """A connection whose answers usually take so long."""
    delay = BrokerDelay()
    delay.usual(usual_s)
    return delay


def at(delay: BrokerDelay, now: float, round_trip_s: float = 0.1) -> float:
    return round(delay.seconds(now, lambda: round_trip_s), 3)


@pytest.mark.parametrize(
    ("usual_s", "events"),
    # a: a ping at that time, b: one behind our own data; r: an answer; k: an acknowledgement of what was sent then;
    # ?: the delay at that time, with another round trip after a slash
    [
        (0.1, "a1 ?1.19=0 r1.19 ?9=0"),
        (0.1, "a1 a1.5 ?1.8=0.7"),  # what comes before an overdue answer is as old as that
        # what comes after it has stood behind the same, also if answers come regularly, each of them late
        (0.1, "a1 a1.5 a2 a2.5 r3 ?3.1=1.9 r3.5 ?3.6=1.9 r4 ?4.1=1.9 r4.5 ?4.6=1.9 a5 r5.1 ?5.2=0"),
        # what others sent may come after all answers: a broker that stood still reads a packet of each client in turn
        (0.1, "?0.9=0 a1 a1.5 a2 ?2.5=1.4 r2.5 r2.5 r2.5 ?2.51=1.4 ?2.69=1.4 a2.51 r2.52 ?2.6=1.4 ?2.71=0"),
        (0.1, "a1 r2 ?2.1=0.9 ?2.1/0.5=0.5 ?2.1/0.9=0.4"),  # a long way is none
        (0.1, "b1 ?3=0 a2 ?3=0.9 r3 ?3=0.9 r3 ?3=0.9"),
        (5.0, "a1 r6 ?6=4"),  # no link is so slow that a second is usual
        (0.1, "r1 ?1=0"),  # an answer without a ping
        (0.1, "a1 a1.5 ?1.6=0.5 k1.2/1.6 ?2.3=0.7 r2.4 k2.3/2.4 ?2.4=0"),  # a later one shows that an answer is lost
    ],
)
def test_how_long_messages_may_have_waited_at_the_broker(usual_s: float, events: str) -> None:
    delay = delayed(usual_s)
    for event in events.split():
        when, _, wanted = event[1:].partition("=")
        number, second = float(when.partition("/")[0]), when.partition("/")[2]
        match event[0]:
            case "a" | "b":
                delay.asked(number, clear=event[0] == "a")
            case "r":
                delay.answered(number)
            case "k":
                delay.acknowledged(number, float(second))
            case _:
                assert at(delay, number, float(second or 0.1)) == float(wanted), event


def test_what_is_delivered_was_sent_before_the_newest_answer_was_asked_for() -> None:
    delay = delayed()
    for sent_at in (1.0, 1.5, 2.0):
        delay.asked(sent_at, clear=False)
    for now, happens, delivered in (
        *((2.1, lambda: None, (2.1, 1.0)), (2.2, lambda: delay.answered(2.2), (2.2, 0.6))),
        *((2.3, delay.delivered, (1.3, 1.1)), (2.3, lambda: delay.answered(2.3), (1.3, 1.1))),
        *((2.4, lambda: delay.answered(2.4), (1.4, 1.1)), (2.4, delay.delivered, (0.4, 0.3))),
    ):
        happens()
        assert tuple(round(one, 3) for one in delay.delivery(now)) == delivered, now


def test_answers_that_come_right_after_the_newest_ping_are_its() -> None:
    near = delayed(0.001)
    near.asked(0.0, clear=True)  # whose answer is lost
    for number in range(1, 9):
        near.asked(number / 2, clear=True)
        assert at(near, number / 2, round_trip_s=0.0) >= 0.4
        near.answered(number / 2 + 0.01)
    assert at(near, 4.3, round_trip_s=0.0) == 0
    near.asked(4.5, clear=True)
    near.answered(4.51)
    assert at(near, 4.9, round_trip_s=0.0) == 0


def test_a_queue_of_constant_length_is_not_taken_for_lost_answers() -> None:
    """Pings are sent after 0.375 to 0.5 s; an answer behind others comes at any time after the newest."""
    usual_s = 0.05
    delay, chance, sent, now = delayed(usual_s), random.Random(1), list[float](), 0.0
    for _ in range(300):
        now += chance.uniform(0.375, 0.5)
        while sent and sent[0] + usual_s + 1.5 <= now:
            answered = sent.pop(0) + usual_s + 1.5
            delay.answered(answered)
            assert at(delay, answered, round_trip_s=usual_s) >= 1.4
        sent.append(now)
        delay.asked(now, clear=True)


# -- filters: which topics they match, which overlap, their Zenoh keys; own and repeated messages


LEVELS = ["a", "b", "$x", "+"]
TOPICS = [
    "/".join(levels) for depth in (1, 2, 3, 4) for levels in itertools.product(["a", "b", "c", "$x"], repeat=depth)
]  # with one level more than any filter has, and one word more
FILTERS = [
    "/".join([*levels, *end])
    for depth in (0, 1, 2, 3)
    for levels in itertools.product(LEVELS, repeat=depth)
    for end in ([], ["#"])
    if levels or end
]


def caught(filter_: str) -> frozenset[str]:
    return frozenset(topic for topic in TOPICS if matches(filter_, topic))


CAUGHT = {filter_: caught(filter_) for filter_ in FILTERS}


def test_overlap_means_that_a_topic_matches_both() -> None:
    for one, other in some(itertools.combinations_with_replacement(FILTERS, 2), 3):
        wanted = bool(CAUGHT[one] & CAUGHT[other])
        assert overlap(one, other) is overlap(other, one) is wanted, (one, other)


def test_subscribed_filters_never_overlap_and_miss_nothing() -> None:
    chosen = random.Random(3)
    for _ in range(3000 if THOROUGH else 25):
        filters, wanted = BrokerFilters(), []
        for filter_ in chosen.sample(FILTERS, 6):
            wanted.append(filter_)
            subscribe, replaced = filters.add(filter_)
            assert subscribe in filters
            assert not set(replaced) & set(filters)
            check(filters, wanted)
        while wanted:
            unwanted = wanted.pop(chosen.randrange(len(wanted)))
            filters.prune(unwanted, wanted)
            check(filters, wanted)
        assert list(filters) == []


def check(filters: BrokerFilters, wanted: list[str]) -> None:
    assert not any(overlap(one, other) for one, other in itertools.combinations(filters, 2))
    needed = frozenset().union(*(CAUGHT[filter_] for filter_ in wanted))
    assert needed <= frozenset().union(*(caught(filter_) for filter_ in filters))


def test_a_copy_is_a_repeat_only_when_one_is_due() -> None:
    own_filter = OwnMessageFilter()
    assert not own_filter.is_repeat(retained("flag", b"1"))
    assert not own_filter.is_repeat(retained("flag", b"1"))  # published again by another client: a new message
    own_filter.subscribe_again("#")
    assert own_filter.is_repeat(retained("flag", b"1"))
    assert not own_filter.is_repeat(retained("flag", b"1"))


def test_a_new_value_that_overtakes_a_due_repeat_is_delivered() -> None:
    own_filter = OwnMessageFilter()
    own_filter.is_repeat(retained("flag", b"1"))
    own_filter.is_repeat(retained("elsewhere", b"1"))
    own_filter.subscribe_again("flag")
    assert not own_filter.is_repeat(retained("flag", b"2"))
    assert own_filter.is_repeat(retained("flag", b"2"))
    assert not own_filter.is_repeat(retained("elsewhere", b"1"))


ODD_LEVELS = ["", "a", "b", "ab", "@", "@a", "$", "$a", "%", "%40", "*", "**", "a*", "?"]
ODD_LEVELS += ["%25", "ä", "a b", "@retain", "$*"]


def random_filter(dice: random.Random) -> str:
    levels = dice.choices([*ODD_LEVELS, "+", "+", "a", "a"], k=dice.randint(1, 4))
    return "/".join([*levels, *dice.choice(([], [], ["#"]))]) or "#"


def random_topic(dice: random.Random) -> str:
    return "/".join(dice.choices([*ODD_LEVELS, "a", "a", "a"], k=dice.randint(1, 5))) or "a"


def test_filters_and_keys_match_where_paho_matches_topics() -> None:
    dice = random.Random(1)
    matched = 0
    for _ in range(cases(4_000, 20_000)):
        filter_, topic = random_filter(dice), random_topic(dice)
        wanted = topic_matches_sub(filter_, topic)
        matched += wanted
        assert matches(filter_, topic) is wanted, (filter_, topic)
        have = zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr(topic_to_key(topic)))
        assert have == wanted, (filter_, topic)
    assert matched > 60


def test_every_topic_comes_back_and_no_two_share_a_key() -> None:
    dice = random.Random(2)
    topics = {random_topic(dice) for _ in range(3_000)}
    keys = {topic_to_key(topic) for topic in topics}
    assert len(keys) == len(topics)
    assert {key_to_topic(key) for key in keys} == topics


@pytest.mark.parametrize(
    ("topic", "key"),
    [
        *((same, same) for same in ("pebble/robots/goob/incoming/drive-values", "Fred's lamp/über", "a-b_c.d")),
        *(("/a//b/", "%/a/%/b/%"), ("@a/@", "%40a/%40"), ("50%", "50%25"), ("$SYS/x", "@%24SYS/x"), ("a/$x", "a/%24x")),
    ],
)
def test_only_what_zenoh_forbids_is_escaped(topic: str, key: str) -> None:
    assert topic_to_key(topic) == key


def test_no_topic_maps_to_the_hubs_own_keys() -> None:
    for filter_ in ("#", "+/#", "@retain/#", "+/+", "@hub/hello"):
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@retain/a"))
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@hub/hello"))


def test_large_payloads_and_many_topics_take_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters, "_LIMIT", 20)
    own_filter = OwnMessageFilter()
    tracemalloc.start()
    for number in range(50):
        message = retained(f"flag{number}", bytes(100_000))
        own_filter.note_own(message)
        own_filter.is_repeat(message)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 500_000
    assert own_filter.is_echo(retained("flag49", bytes(100_000)))
    assert not own_filter.is_echo(retained("flag0", bytes(100_000)))
