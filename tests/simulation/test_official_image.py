"""The serial robots on the image that MicroPython publishes for their board: no select, streams of text only."""

from __future__ import annotations

import re

import pytest

from pebble.simulation.bodies import Body, body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import VirtualClock
from pebble.simulation.micropython.ports import SAMD21_OFFICIAL


class Over(BaseException):
    """Ends the endless loop."""


class Host:
    """Types at given times, and records the board's output and motor changes with their times."""

    def __init__(self, kind: str, script: dict[float, bytes], ends: float) -> None:
        self.clock = VirtualClock()
        self.board = Board(self.clock, port=SAMD21_OFFICIAL)
        self.body: Body = body_of(kind, self.board)
        self.motors: list[tuple[float, tuple[float, float]]] = []
        self.body.on_motors = lambda now, motors: self.motors.append((now, motors))
        self.output: list[tuple[float, bytes]] = []
        self._script, self._ends = dict(script), ends
        self.board.timers.on_wait = self._check
        with pytest.raises(Over):
            self.board.firmware.run(f"{kind}/main.py")

    def lines(self, pattern: bytes) -> list[float]:
        """The times of output lines like this."""
        return [when for when, data in self.output for line in data.splitlines() if re.fullmatch(pattern, line)]

    def _check(self) -> None:
        now = self.clock.now()
        self.body.end_turn()
        if output := self.board.take_output():
            self.output.append((now, output))
        for when in [when for when in self._script if when <= now]:
            self.board.type(self._script.pop(when))
        if now >= self._ends:
            raise Over


@pytest.mark.parametrize("kind", ["goob", "fred"])
def test_it_obeys_answers_and_stops_in_silence(kind: str) -> None:
    host = Host(kind, {1.5: b"M 0.5 0.5\n", 2.0: b"M 0.5 0.5\r\nL 0 1 0\nX\n", 2.1: b"M 0 \x03 nothing"}, 4.0)
    (began, _), (ended, off) = host.motors
    assert began == pytest.approx(1.5, abs=0.02)
    assert off == (0.0, 0.0)
    assert 2.99 <= ended <= 3.03
    assert [len(host.lines(rb"OK M")), len(host.lines(rb"OK L")), len(host.lines(rb"ERR .*"))] == [2, 1, 1]
    assert host.board.resets == 0


@pytest.mark.parametrize(("kind", "rate_hz"), [("goob", 50), ("fred", 2)])
def test_it_reports_on_time(kind: str, rate_hz: int) -> None:
    reports = Host(kind, {}, 11.0).lines(rb"T [at]0=.*")
    assert len([when for when in reports if when > 1.0]) == pytest.approx(rate_hz * 10, abs=2)


def test_a_host_that_does_not_read_does_not_keep_the_motors_running() -> None:
    script = {1.2 + 0.1 * count: b"M 1 1\n" for count in range(20)}
    clock_of_silence = max(script)
    host = Deaf("goob", script, 6.0)
    assert host.motors[-1][1] == (0.0, 0.0)
    assert host.motors[-1][0] - clock_of_silence <= 1.6, "one wait of half a second may come in between"


class Deaf(Host):
    """Holds the port open and reads nothing."""

    def _check(self) -> None:
        self.board.console.reading = False
        now = self.clock.now()
        self.body.end_turn()
        for when in [when for when in self._script if when <= now]:
            self.board.type(self._script.pop(when))
        if now >= self._ends:
            raise Over
