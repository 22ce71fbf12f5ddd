"""Which messages are acknowledged, and how old the oldest of the others is."""

from __future__ import annotations

import pytest

from pebble.extensions.media.in_flight import InFlight


def test_messages_are_acknowledged_in_order() -> None:
    messages = InFlight(slack=60)
    assert messages.acknowledge(5000) == []
    for number in range(10):
        messages.sent(660, number / 10)
    assert messages.acknowledge(10 * 650) == []
    assert messages.age_s(1.0) == pytest.approx(1.0)
    assert [message.at for message in messages.acknowledge(3 * 650)] == [number / 10 for number in range(7)]
    assert messages.age_s(1.0) == pytest.approx(0.3)
    assert len(messages) == 3
    assert len(messages.acknowledge(20)) == 3, "a ping is no message"
    assert (messages.oldest, messages.age_s(1.0)) == (None, 0)
    messages.sent(600, 2.0)
    messages.clear()
    assert messages.age_s(3.0) == 0, "a lost connection loses its messages"
    messages = InFlight(slack=0, limit=2)
    for number in range(3):
        messages.sent(100, float(number))
    assert messages.age_s(3.0) == 2.0, "only so many are remembered"
