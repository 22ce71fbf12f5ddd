"""The age of messages from other machines, whose clocks started some other time."""

from __future__ import annotations

import pytest

from pebble.transports.ages import MessageAges

HERE, THERE, TOPIC = 1, 2, "a/b"
LATE_S = 2.0


class Receiver:
    """Its clock shows ``now``; the operator's is ``offset`` behind, and counts ``rate`` seconds per second."""

    def __init__(self, offset: float = 5000.0, rate: float = 1.0) -> None:
        self.ages = MessageAges(HERE, LATE_S)
        self._offset, self._rate = offset, rate

    def receives(self, now: float, journey: float = 0.01) -> float:
        return self.ages.age_s(THERE, TOPIC, (now - journey) * self._rate - self._offset, now)


@pytest.mark.parametrize("offset", [5000.0, -5000.0])
def test_what_piled_up_is_as_old_as_it_is(offset: float) -> None:
    receiver = Receiver(offset)
    assert [receiver.receives(now / 10) for now in range(10)] == pytest.approx([0.0] * 10, abs=0.01)
    piled_up = [receiver.receives(7.0, journey=journey) for journey in (6.0, 4.0, 2.5, 1.0, 0.01)]
    assert piled_up == pytest.approx([6.0, 4.0, 2.5, 1.0, 0.0], abs=0.02)


@pytest.mark.parametrize("rate", [1.0005, 0.9995])
def test_drifting_clocks_stay_comparable(rate: float) -> None:
    receiver = Receiver(rate=rate)
    assert max(receiver.receives(10.0 * turn) for turn in range(10_000)) < 0.1
    assert receiver.receives(100_010.0, journey=5.0) == pytest.approx(5.0, abs=0.1)


def test_standing_still_twice_is_no_reason_to_believe_old_messages() -> None:
    receiver = Receiver()
    receiver.receives(0.0)
    for now in (10.0, 20.0, 30.0):
        assert receiver.receives(now, journey=4.0) > LATE_S


def test_a_clock_that_stood_still_is_believed_again_soon() -> None:
    """A virtual machine was paused: all its messages seem late from then on, for ever."""
    receiver = Receiver()
    receiver.receives(0.0)
    seemed = [receiver.receives(100.0 + turn / 10, journey=60.0) for turn in range(100)]
    assert seemed[0] > LATE_S
    assert seemed[-1] == pytest.approx(0.0, abs=0.01)


def test_who_claims_to_be_another_machine_makes_nothing_of_it_late_on_other_topics() -> None:
    receiver = Receiver()
    for now in range(60):
        receiver.ages.age_s(THERE, "a/mine", now - 5000.0 + 10.0, now)
        assert receiver.receives(now) < LATE_S


def test_many_machines_take_no_memory() -> None:
    ages = MessageAges(HERE, LATE_S)
    for boot in range(10, 1000):
        ages.age_s(boot, TOPIC, 0.0, 0.0)
    assert len(ages) <= 256
