"""What the keys of a terminal send, and everything that ends it."""

from __future__ import annotations

import itertools

import pytest

from pebble.client.terminal.key_gesture import BURST, HELD_S, PERIOD_S, KeyGesture, mixed
from pebble.contract.payloads import Drive

FORWARD, ZERO, FINAL = Drive(z=0.6, valid_ms=400), Drive(), Drive(valid_ms=0)
TICK = 0.05


class Typist:
    """Calls a gesture every 50 ms, as its program does."""

    def __init__(self, speed: float = 0.6, turn: float = 0.8) -> None:
        self.gesture = KeyGesture(speed, turn)
        self.now = 0.0
        self.sent: list[tuple[float, Drive]] = []
        self.run(0.6)

    def run(self, seconds: float, key: str = "", *, every: float = 0.0, allowed: bool = True) -> list[Drive]:
        """Let time pass; ``key`` arrives at its beginning, and then ``every`` so many seconds."""
        start = len(self.sent)
        keys = itertools.count(self.now, every) if every else iter([self.now])
        key_at = next(keys) if key else float("inf")
        for _ in range(round(seconds / TICK)):
            while key_at <= self.now + 1e-9:
                self.gesture.press([key], self.now)
                key_at = next(keys, float("inf"))
            self.take(self.gesture.update(allowed, self.now))
            self.now = round(self.now + TICK, 6)
        return [drive for _, drive in self.sent[start:]]

    def take(self, drives: list[Drive]) -> None:
        self.sent += [(self.now, drive) for drive in drives]

    @property
    def moves(self) -> list[float]:
        return [at for at, drive in self.sent if drive.moves]


def test_a_held_key_is_sent_every_50_ms_and_ends_with_three_zeros() -> None:
    typist = Typist()
    held = typist.run(1.0, "w", every=0.05)
    assert held == [FORWARD] * 20
    after = typist.run(1.0)
    assert after[after.count(FORWARD) :] == [ZERO] * 3
    assert 7 <= after.count(FORWARD) <= 8, "the last repetition came 50 ms before"
    assert {round(b - a, 3) for a, b in itertools.pairwise(typist.moves)} == {PERIOD_S}


def test_a_tap_moves_for_as_long_as_a_key_counts_as_held() -> None:
    typist = Typist()
    sent = typist.run(2.0, "w")
    assert HELD_S / TICK <= sent.count(FORWARD) <= HELD_S / TICK + 1
    assert sent[sent.count(FORWARD) :] == [ZERO] * 3


def test_a_first_repetition_that_is_later_than_that_halts_in_between() -> None:
    typist = Typist()
    typist.run(0.5, "w")
    assert typist.run(0.5, "w", every=0.03)[:1] == [FORWARD]


@pytest.mark.parametrize(
    ("key", "drive"),
    [
        ("w", Drive(z=0.6, valid_ms=400)), ("up", Drive(z=0.6, valid_ms=400)),
        ("s", Drive(z=-0.6, valid_ms=400)), ("down", Drive(z=-0.6, valid_ms=400)),
        ("a", Drive(x=-0.8, valid_ms=400)), ("left", Drive(x=-0.8, valid_ms=400)),
        ("d", Drive(x=0.8, valid_ms=400)), ("right", Drive(x=0.8, valid_ms=400)),
        ("q", Drive(y=0.6, valid_ms=400)), ("e", Drive(y=-0.6, valid_ms=400)),
    ],
)  # fmt: skip
def test_what_each_key_does(key: str, drive: Drive) -> None:
    assert Typist().run(0.05, key) == [drive]


@pytest.mark.parametrize("key", ["x", "1", "escape", "space", "end", "!"])
def test_other_keys_move_nothing(key: str) -> None:
    assert Typist().run(0.3, key) == []


def test_axes_are_mixed_as_the_page_does() -> None:
    assert mixed(0.8, 0.6, 0.0) == Drive(x=round(0.8 / 1.4, 3), z=round(0.6 / 1.4, 3), valid_ms=400)
    typist = Typist()
    typist.gesture.press(["w", "d"], typist.now)
    assert typist.run(0.05) == [mixed(0.8, 0.6, 0.0)]


def test_the_newest_key_of_an_axis_counts() -> None:
    typist = Typist()
    typist.run(0.1, "w")
    assert typist.run(0.05, "s") == [Drive(z=-0.6, valid_ms=400)]


def test_a_slow_connection_limits_the_speed() -> None:
    typist = Typist(speed=1.0, turn=1.0)
    typist.gesture.press(["w"], typist.now)
    assert typist.gesture.update(True, typist.now, limit=0.4) == [Drive(z=0.4, valid_ms=400)]


@pytest.mark.parametrize("stall", [0.3, 1.5, 3600.0])
def test_after_a_stall_of_our_own_held_keys_move_nothing_until_they_were_released(stall: float) -> None:
    typist = Typist()
    typist.run(0.5, "w", every=0.05)
    typist.now += stall
    assert typist.run(1.0, "w", every=0.05) == [FINAL] * 3
    typist.run(HELD_S + 0.1)
    assert typist.run(0.1, "w") == [FORWARD] * 2


def test_the_pause_of_a_released_key_begins_after_the_stall() -> None:
    """What was typed meanwhile may be lost, and the next repetition comes a little later."""
    typist = Typist()
    typist.run(0.5, "w", every=0.05)
    typist.now += 5.0
    typist.run(0.1)
    assert [drive for drive in typist.run(1.0, "w", every=0.03) if drive.moves] == []


def test_keys_that_arrived_during_a_stall_move_nothing_either() -> None:
    typist = Typist()
    typist.now += 1.0
    assert typist.run(0.3, "w", every=0.05) == []


def test_a_burst_of_keys_was_held_back_on_the_way_and_moves_nothing() -> None:
    typist = Typist()
    typist.run(0.5, "w", every=0.05)
    typist.gesture.press(["w"] * BURST, typist.now)
    assert typist.run(0.5, "w", every=0.05) == [FINAL] * 3
    typist.run(HELD_S + 0.1)
    typist.gesture.press(["w"] * (BURST - 1), typist.now)
    assert typist.run(0.05) == [FORWARD]


def test_what_forbids_driving_ends_the_gesture_until_the_keys_were_released() -> None:
    typist = Typist()
    typist.run(0.5, "w", every=0.05)
    assert typist.run(0.3, "w", every=0.05, allowed=False) == [FINAL] * 3
    assert typist.run(1.0, "w", every=0.05) == []
    assert typist.gesture.must_release
    typist.run(HELD_S + 0.1)
    assert typist.run(0.05, "w") == [FORWARD]


def test_a_key_that_was_pressed_while_driving_was_forbidden_begins_nothing() -> None:
    typist = Typist()
    assert typist.run(0.5, "w", every=0.05, allowed=False) == []
    assert typist.run(0.5, "w", every=0.05) == []
    typist.run(HELD_S + 0.1)
    assert typist.run(0.05, "w") == [FORWARD]


def test_a_stop_is_always_sent() -> None:
    typist = Typist()
    assert typist.gesture.stop(typist.now) == [FINAL]
    assert typist.run(0.5) == [FINAL] * 2
    typist.run(0.5, "w", every=0.05)
    assert typist.gesture.stop(typist.now) == [FINAL]
    assert typist.run(0.5, "w", every=0.05) == [FINAL] * 2


def test_an_interruption_without_a_gesture_sends_nothing() -> None:
    typist = Typist()
    assert typist.gesture.interrupt(typist.now) == []


def test_for_another_driver_the_zero_is_not_repeated() -> None:
    typist = Typist()
    typist.run(0.2, "w")
    assert typist.gesture.interrupt(typist.now, repeat=False) == [FINAL]
    assert typist.run(0.5) == []


def test_the_zeros_of_a_gesture_end_when_the_next_one_begins() -> None:
    typist = Typist()
    typist.run(0.2, "w")
    while typist.gesture.active:
        typist.run(TICK)
    assert typist.sent[-1][1] == ZERO
    assert typist.run(0.2, "w") == [FORWARD] * 4
