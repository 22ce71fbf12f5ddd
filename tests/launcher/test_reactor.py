"""The launcher's clock: it does not run while the launcher itself stands still."""

from __future__ import annotations

import os

import pytest

from pebble.launcher.reactor import Reactor


class Frozen:
    """A reactor that does not wait, because there is always something to read; a turn takes 0.5 s of its clock."""

    def __init__(self, *freezes: str) -> None:
        self.time = 1000.0
        self.stalls: list[float] = []
        self.reactor = Reactor(lambda: self.time, on_stall=self.stalls.append)
        self._freezes = list(freezes)
        self._pipe = os.pipe()
        os.write(self._pipe[1], b"a note")
        self.reactor.watch(self._pipe[0], lambda: self.stand_still("reading"))

    def stand_still(self, where: str) -> None:
        if where in self._freezes:
            self._freezes.remove(where)
            self.time += 12.0

    def turns(self, timeout: float) -> float:
        """How long the clock ran until nothing more was due."""
        began = self.time

        def turn() -> bool:
            self.time += 0.5
            self.stand_still("waiting")
            return False

        self.reactor.run_until(turn, timeout)
        return self.time - began

    def close(self) -> None:
        self.reactor.close()
        for end in self._pipe:
            os.close(end)


@pytest.mark.parametrize("where", ["reading", "waiting"])
def test_a_time_in_which_it_stood_still_makes_nothing_due(where: str) -> None:
    frozen, due = Frozen(where), list[float]()
    frozen.reactor.after(10.0, lambda: due.append(frozen.time))
    assert frozen.turns(8.0) == pytest.approx(8.0 + 12.0, abs=1.0), "its own limits are on the same clock"
    assert not due
    assert frozen.stalls == [pytest.approx(12.0, abs=1.0)]
    frozen.turns(8.0)
    assert due == [pytest.approx(1000.0 + 10.0 + 12.0, abs=1.0)]
    frozen.close()


def test_a_launcher_that_gets_little_time_still_ends_what_hangs() -> None:
    frozen, due = Frozen(*["waiting"] * 20), list[float]()
    frozen.reactor.after(5.0, lambda: due.append(frozen.time))
    frozen.turns(10.0)
    assert due
    frozen.close()
