"""Judges a robot by the trace of its motors: did it move when driven, and stand when released? Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from pebble.extensions.lab.simulation.trace import Entry

STOPS_S = 1.2  # the second of the contract, and what a simulated board may lose on a busy machine

Wheels = tuple[float, float]  # left and right, -1..1


class Driven(NamedTuple):
    """A robot's commanded motion: when it was driven, released or stopped. Times are seconds of time.monotonic()."""

    robot: str  # its id
    step: str
    wheels: Wheels  # as commanded
    began: float
    released: float  # the last command that moves it, or the stop
    ended: float  # until then it has to stand


class Outcome(NamedTuple):
    """The motion of a robot in one step; ``wrong`` is empty if it was as commanded."""

    robot: str
    step: str
    off_s: float  # from the release until its motors were off; infinite if they never were
    wrong: str


def outcome_of(driven: Driven, entries: Sequence[Entry]) -> Outcome:
    """Return the outcome of a step, by the motors' changes in ``entries``, which are in the order of time."""
    changes = [(entry.ns / 1e9, entry.motors) for entry in entries if entry.motors is not None]
    changes = [(at, wheels) for at, wheels in changes if at < driven.ended]
    moved = any(driven.began <= at < driven.released and _same_way(wheels, driven.wheels) for at, wheels in changes)
    off_s = max(0.0, _off_at(changes) - driven.released)
    wrong = ""
    if not moved:
        wrong = "it did not move as commanded"
    elif math.isinf(off_s):
        wrong = "its motors did not stop"
    elif off_s > STOPS_S:
        wrong = f"its motors ran for {off_s:.2f} s after it was let go"
    return Outcome(driven.robot, driven.step, off_s, wrong)


def _same_way(wheels: Wheels, commanded: Wheels) -> bool:
    return all(speed * wanted > 0 for speed, wanted in zip(wheels, commanded, strict=True))


def _off_at(changes: Sequence[tuple[float, Wheels]]) -> float:
    """Return the time at which the motors were last switched off; infinite if they run at the end."""
    off_at = -math.inf  # they have not run
    for at, wheels in changes:
        if any(wheels):
            off_at = math.inf
        elif off_at == math.inf:
            off_at = at
    return off_at


class Outcomes:
    """The worst outcome of each robot and step; its size does not grow with time."""

    def __init__(self) -> None:
        self._worst: dict[tuple[str, str], Outcome] = {}

    def add(self, outcome: Outcome) -> None:
        earlier = self.of(outcome.robot, outcome.step)
        if earlier is None or (bool(outcome.wrong), outcome.off_s) >= (bool(earlier.wrong), earlier.off_s):
            self._worst[outcome.robot, outcome.step] = outcome

    def of(self, robot: str, step: str) -> Outcome | None:
        return self._worst.get((robot, step))

    def steps(self) -> list[str]:
        return list(dict.fromkeys(step for _, step in self._worst))

    def problems(self, robot: str) -> list[str]:
        """Return what went wrong with a robot, step by step."""
        return [
            f"{worst.step}: {worst.wrong}" for worst in self._worst.values() if worst.robot == robot and worst.wrong
        ]
