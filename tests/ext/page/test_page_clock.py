"""How old a page's messages are, whatever its clock shows, and how many it may send a second."""

from __future__ import annotations

import pytest

from pebble.extensions.page.pace import BURST, PER_S, Pace
from pebble.extensions.page.page_clock import ClockJumpError, PageClock

OFFSET_S = 5000.0  # of the page's clock


class Page:
    """A page whose messages take ``up`` and ``down`` seconds."""

    def __init__(self, up: float, down: float, *, drift: float = 0.0) -> None:
        self.clock = PageClock()
        self.up, self.down, self.drift = up, down, drift
        self.now = 100.0

    def page_ms(self, at: float) -> float:
        return 1000 * (OFFSET_S + at * (1 + self.drift))

    def ping(self, times: int = 1) -> Page:
        for _ in range(times):
            number = self.clock.ping(self.now)
            stamp = self.page_ms(self.now + self.down)
            self.now += self.down + self.up
            self.clock.echo(number, stamp, self.now)
            self.now += max(0.0, 0.5 - self.down - self.up)
        return self

    def late(self, age: float) -> bool:
        """Whether a command that was sent so long ago is too old."""
        return self.clock.late(self.page_ms(self.now - age), self.now)


STALLED = "the connection to the page is stalled"
#: Delays to the server and to the page, pings, and the ages of commands in seconds that are not too old, and that are.
AGES = {
    "quick": (0.003, 0.003, 1, [0.003], []),
    "always slow to the server": (0.7, 0.003, 40, [], [0.7]),
    "slow both ways": (0.35, 0.35, 40, [], []),
    "a delay that was always there counts": (0.4, 0.02, 40, [0.45], [0.61]),
    "held back": (0.003, 0.003, 5, [], [0.7, 30.0]),
    "limited to the usual round trip and a little": (0.02, 0.02, 5, [0.28], [0.36]),
}


@pytest.mark.parametrize(("up", "down", "pings", "in_time", "late"), AGES.values(), ids=AGES)
def test_commands_are_too_old(up: float, down: float, pings: int, in_time: list[float], late: list[float]) -> None:
    page = Page(up, down).ping(pings)
    assert [page.late(age) for age in in_time + late] == [False] * len(in_time) + [True] * len(late)
    assert bool(page.clock.problem(page.now)) is (up + down > 0.5)


def test_before_the_first_echo_nothing_may_move() -> None:
    clock = PageClock()
    clock.ping(1.0)
    assert clock.late(1.0, 1.0)
    assert clock.problem(1.0) == STALLED


#: Whether a further ping is sent, the seconds after the newest echo, and what is wrong then.
@pytest.mark.parametrize(
    ("pings", "seconds", "problem"),
    [(False, 0.99, ""), (False, 1.01, STALLED), (True, 0.59, ""), (True, 0.61, "commands are late (610 ms)")],
)
def test_a_page_without_answers_may_not_drive(pings: bool, seconds: float, problem: str) -> None:
    page = Page(0.003, 0.003).ping(5)
    newest = page.now - 0.494
    if pings:
        page.clock.ping(newest)
    assert page.clock.problem(newest + seconds) == problem


def test_a_round_trip_that_was_refused_counts_until_the_next_one() -> None:
    page = Page(0.003, 0.003).ping(5)
    page.up = 0.7
    assert "late" in page.ping().clock.problem(page.now)
    page.up = 0.003
    assert page.ping().clock.problem(page.now) == ""


def test_messages_that_wait_do_not_move_the_base() -> None:
    page = Page(0.003, 0.003).ping(5)
    page.up = 0.5
    page.ping(10)
    assert [page.late(age) for age in (0.65, 0.5)] == [True, True]


@pytest.mark.parametrize("jump", [1.5, -1.5])
def test_a_jump_of_the_pages_clock_ends_the_connection(jump: float) -> None:
    page = Page(0.003, 0.003).ping(3)
    number = page.clock.ping(page.now)
    with pytest.raises(ClockJumpError):
        page.clock.echo(number, page.page_ms(page.now) + 1000 * jump, page.now + 0.006)


def test_a_command_from_the_future_ends_the_connection() -> None:
    with pytest.raises(ClockJumpError):
        Page(0.003, 0.003).ping(3).late(-1.5)


@pytest.mark.parametrize("drift", [0.001, -0.001])
def test_clocks_may_drift_apart_for_long(drift: float) -> None:
    page = Page(0.02, 0.02, drift=drift).ping(7200)
    assert [page.late(age) for age in (0.02, 0.62)] == [False, True]


def test_an_echo_of_no_ping_is_ignored() -> None:
    page = Page(0.003, 0.003).ping(3)
    page.clock.echo(999, 0.0, page.now)
    page.clock.echo(1, 0.0, page.now)
    assert not page.late(0.003)


@pytest.mark.parametrize(
    ("took", "shown"),
    [
        ([0.1, 0.1, 0.5, 0.1], 0.1),  # one slow answer
        ([0.31, 0.29, 0.31, 0.29], 0.31),  # at the limit it does not change
        ([0.5, 0.5, 0.1, 0.1, 0.1], 0.1),
        ([0.1, 0.1, 0.7], 0.7),  # late: commands are refused
    ],
)
def test_people_are_told_of_a_connection_that_stays_slow(took: list[float], shown: float) -> None:
    page = Page(0.0, 0.0)
    for page.up in took:
        page.ping()
    assert page.clock.shown_round_trip_s == pytest.approx(shown)


# -- many messages


def test_a_burst_does_not_wait_and_what_follows_is_paced() -> None:
    pace = Pace(1000.0)
    assert [pace.take(1, 1000.0) for _ in range(int(BURST))] == [0.0] * int(BURST)
    assert pace.take(1, 1000.0) == pytest.approx(1 / PER_S)
    assert pace.take(20, 1000.0) == pytest.approx(21 / PER_S)
    assert pace.take(1, 1001.0) == 0
    assert [pace.take(BURST, 2000.0), pace.take(1, 2000.0) > 0] == [0, True], "a burst at most"
