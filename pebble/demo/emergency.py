"""Judges an emergency stop of the demo by what the robots' MCUs measured. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pebble.demo.operator import EMERGENCY_STOP, CompletedStop
from pebble.simulation.trace import Entry

_STOPPED_S = 1.0  # until the motors are off


@dataclass(frozen=True, slots=True)
class StopResult:
    """What was measured, and its defects (empty: none)."""

    robot: str
    stop_s: float
    confirmed_s: float | None
    wrong: tuple[str, ...]
    step: str = EMERGENCY_STOP

    @property
    def summary(self) -> str:
        confirmed = "" if self.confirmed_s is None else f", confirmed {self.confirmed_s * 1000:.0f}"
        return f"off {self.stop_s * 1000:.0f}{confirmed} ms"


def assess(completed: CompletedStop, entries: Sequence[Entry]) -> StopResult:
    """Judge a stop by the trace of the motors."""
    motors = [(entry.ns / 1e9, entry.motors != (0.0, 0.0)) for entry in entries if entry.motors is not None]

    def ran(after: float, before: float) -> bool:
        return any(runs for at, runs in motors if after < at < before)

    ran_before = [runs for at, runs in motors if at < completed.pressed][-1:] == [True]
    off_at = next((at for at, runs in motors if at >= completed.pressed and not runs), math.inf)
    stop_s = off_at - completed.pressed
    wrong = [
        *([] if ran_before else ["it did not move when it was stopped"]),
        *([] if stop_s <= _STOPPED_S else ["its motors did not stop"]),
        *(["its motors ran before the reset"] if ran(off_at, completed.reset) else []),
        *([] if completed.confirmed_s is not None else ["it did not confirm the stop"]),
        *([] if completed.is_free else ["the reset was not confirmed"]),
        *([] if ran(completed.reset, completed.ended) else ["it did not move after the reset"]),
    ]
    return StopResult(completed.robot, stop_s, completed.confirmed_s, tuple(wrong))
