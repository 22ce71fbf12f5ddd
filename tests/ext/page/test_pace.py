"""A page may send bursts, and 100 messages a second."""

from __future__ import annotations

import pytest

from pebble.extensions.page.pace import BURST, PER_S, Pace


def test_a_burst_does_not_wait_and_what_follows_is_paced() -> None:
    pace = Pace(1000.0)
    assert [pace.take(1, 1000.0) for _ in range(int(BURST))] == [0.0] * int(BURST)
    assert pace.take(1, 1000.0) == pytest.approx(1 / PER_S)
    assert pace.take(20, 1000.0) == pytest.approx(21 / PER_S)


def test_it_recovers() -> None:
    pace = Pace(0.0)
    pace.take(BURST, 0.0)
    assert pace.take(1, 1.0) == 0
    assert pace.take(BURST, 1000.0) == 0
    assert pace.take(1, 1000.0) > 0


def test_a_page_that_drives_never_waits() -> None:
    pace = Pace(0.0)
    assert not any(pace.take(1, step / 25) for step in range(25 * 600))
