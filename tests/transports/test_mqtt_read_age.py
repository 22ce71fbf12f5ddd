"""Since when received bytes may have waited in the kernel."""

from __future__ import annotations

import random
import socket

import pytest

from pebble.transports.mqtt.outgoing import readable_bytes
from pebble.transports.mqtt.read_age import BrokerDelay, WaitingTime


def test_bytes_that_come_into_an_empty_socket_have_not_waited() -> None:
    waiting = WaitingTime(1.0)
    waiting.empty(5.0)
    waiting.found(100, 5.0)
    assert waiting.since == 5.0


def test_bytes_found_after_a_stop_may_have_waited_since_the_socket_was_last_empty() -> None:
    waiting = WaitingTime(1.0)
    waiting.empty(5.0)
    waiting.found(1000, 9.0)
    assert waiting.since == 5.0


def test_all_that_piled_up_is_as_old_and_what_came_later_is_not() -> None:
    waiting = WaitingTime(1.0)
    waiting.found(1000, 9.0)
    for now in (9.1, 9.2, 9.3):  # batches; more comes meanwhile
        waiting.read(400)
        assert waiting.since == 1.0
        waiting.found(2000, now)
    assert waiting.since == 9.0


def test_an_emptied_socket_ends_it() -> None:
    waiting = WaitingTime(1.0)
    waiting.found(1000, 9.0)
    waiting.read(900)
    waiting.empty(9.1)
    waiting.found(10, 9.2)
    assert waiting.since == 9.1


def test_the_kernel_knows_how_much_is_there() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert readable_bytes(ours) == 0
        theirs.send(b"123")
        assert readable_bytes(ours) == 3
    assert readable_bytes(ours) == 0


class TestBrokerDelay:
    """A connection whose answers usually take 0.1 s."""

    @pytest.fixture
    def delay(self) -> BrokerDelay:
        delay = BrokerDelay()
        delay.usual(0.1)
        return delay

    @staticmethod
    def at(delay: BrokerDelay, now: float, round_trip_s: float = 0.1) -> float:
        return round(delay.seconds(now, lambda: round_trip_s), 3)

    def test_usual_answers_are_no_delay(self, delay: BrokerDelay) -> None:
        delay.asked(1.0, clear=True)
        assert self.at(delay, 1.19) == 0
        delay.answered(1.19)
        assert self.at(delay, 9.0) == 0

    def test_what_comes_before_an_overdue_answer_is_as_old_as_that(self, delay: BrokerDelay) -> None:
        delay.asked(1.0, clear=True)
        delay.asked(1.5, clear=True)
        assert self.at(delay, 1.8) == 0.7

    def test_what_comes_after_it_has_stood_behind_the_same(self, delay: BrokerDelay) -> None:
        """Also if answers come regularly, each of them late."""
        for number in range(4):
            delay.asked(1.0 + number / 2, clear=True)
        for number in range(4):
            delay.answered(3.0 + number / 2)
            assert self.at(delay, 3.1 + number / 2) == 1.9
        delay.asked(5.0, clear=True)
        delay.answered(5.1)
        assert self.at(delay, 5.2) == 0

    def test_what_others_sent_meanwhile_may_come_after_all_answers(self, delay: BrokerDelay) -> None:
        """A broker that stood still reads a packet of each client in turn."""
        assert self.at(delay, 0.9) == 0
        for sent_at in (1.0, 1.5, 2.0):
            delay.asked(sent_at, clear=True)
        assert self.at(delay, 2.5) == 1.4
        for _ in range(3):
            delay.answered(2.5)
        assert self.at(delay, 2.51) == self.at(delay, 2.69) == 1.4
        delay.asked(2.51, clear=True)
        delay.answered(2.52)
        assert self.at(delay, 2.6) == 1.4
        assert self.at(delay, 2.71) == 0

    def test_a_long_way_is_none(self, delay: BrokerDelay) -> None:
        delay.asked(1.0, clear=True)
        delay.answered(2.0)
        assert self.at(delay, 2.1) == 0.9
        assert self.at(delay, 2.1, round_trip_s=0.5) == 0.5
        assert self.at(delay, 2.1, round_trip_s=0.9) == 0.4  # half a second more than usual, and not more

    def test_a_ping_behind_our_own_data_means_nothing(self, delay: BrokerDelay) -> None:
        delay.asked(1.0, clear=False)
        assert self.at(delay, 3.0) == 0
        delay.asked(2.0, clear=True)
        assert self.at(delay, 3.0) == 0.9
        delay.answered(3.0)
        assert self.at(delay, 3.0) == 0.9
        delay.answered(3.0)
        assert self.at(delay, 3.0) == 0.9

    def test_no_link_is_so_slow_that_a_second_is_usual(self) -> None:
        delay = BrokerDelay()
        delay.usual(5.0)
        delay.asked(1.0, clear=True)
        delay.answered(6.0)
        assert self.at(delay, 6.0) == 4.0

    def test_what_is_delivered_was_sent_before_the_newest_answer_was_asked_for(self, delay: BrokerDelay) -> None:
        for sent_at in (1.0, 1.5, 2.0):
            delay.asked(sent_at, clear=False)
        for at, happens, delivered in (
            *((2.1, lambda: None, (2.1, 1.0)), (2.2, lambda: delay.answered(2.2), (2.2, 0.6))),
            *((2.3, delay.delivered, (1.3, 1.1)), (2.3, lambda: delay.answered(2.3), (1.3, 1.1))),
            *((2.4, lambda: delay.answered(2.4), (1.4, 1.1)), (2.4, delay.delivered, (0.4, 0.3))),
        ):
            happens()
            assert tuple(round(one, 3) for one in delay.delivery(at)) == delivered, at

    def test_an_answer_without_a_ping_is_none(self, delay: BrokerDelay) -> None:
        delay.answered(1.0)
        assert self.at(delay, 1.0) == 0

    def test_a_later_acknowledgement_shows_that_an_answer_is_lost(self, delay: BrokerDelay) -> None:
        delay.asked(1.0, clear=True)
        delay.asked(1.5, clear=True)
        assert self.at(delay, 1.6) == 0.5
        delay.acknowledged(1.2, 1.6)
        assert self.at(delay, 2.3) == 0.7
        delay.answered(2.4)
        delay.acknowledged(2.3, 2.4)
        assert self.at(delay, 2.4) == 0

    def test_answers_that_come_right_after_the_newest_ping_are_its(self) -> None:
        near = BrokerDelay()
        near.usual(0.001)
        near.asked(0.0, clear=True)  # whose answer is lost
        for number in range(1, 9):
            near.asked(number / 2, clear=True)
            assert self.at(near, number / 2, round_trip_s=0.0) >= 0.4
            near.answered(number / 2 + 0.01)
        assert self.at(near, 4.3, round_trip_s=0.0) == 0
        near.asked(4.5, clear=True)
        near.answered(4.51)
        assert self.at(near, 4.9, round_trip_s=0.0) == 0

    @pytest.mark.parametrize("usual_s", [0.001, 0.05, 0.6])
    def test_a_queue_of_constant_length_is_not_taken_for_lost_answers(self, usual_s: float) -> None:
        """Pings are sent after 0.375 to 0.5 s; an answer behind others comes at any time after the newest."""
        delay, chance, sent, now = BrokerDelay(), random.Random(1), list[float](), 0.0
        delay.usual(usual_s)
        for _ in range(300):
            now += chance.uniform(0.375, 0.5)
            while sent and sent[0] + usual_s + 1.5 <= now:
                at = sent.pop(0) + usual_s + 1.5
                delay.answered(at)
                assert self.at(delay, at, round_trip_s=usual_s) >= 1.4
            sent.append(now)
            delay.asked(now, clear=True)
