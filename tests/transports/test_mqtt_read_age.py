"""Since when received bytes may have waited in the kernel or at the broker."""

from __future__ import annotations

import random

import pytest

from pebble.transports.mqtt.read_age import BrokerDelay, WaitingTime


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
