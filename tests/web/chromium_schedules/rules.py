"""What must be true of the wheels, computed from what was held at the pages and from the motors' trace.

An input is alive from its press until it is released or interrupted. No wheel turns in a direction that no subset of
the inputs that are alive asks for; so none resumes by itself, since what was interrupted stays dead until a new press.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

Motors = list[tuple[float, tuple[float, float]]]

BUSY_S = 0.45  # what a busy machine may add to each deadline
PAGE_S = 0.1  # the page sends a zero at once
SILENCE_S = 0.35  # the server notices within 0.25 s and looks every 50 ms
VALID_S = 0.5  # a command counts for 0.4 s at the robot
CERTAIN_S = 0.8  # what stands still for so long ends a gesture in any case
_EPS = 0.005


@dataclass(slots=True, eq=False)
class Press:
    """An input of a tab; ``axes`` are steering and throttle. ``until``: the wheels are at rest at the latest."""

    tab: int
    name: str
    axes: tuple[int, int]
    began: float
    until: float = float("inf")
    why: str = "it is held"

    def end(self, at: float, within: float, why: str) -> None:
        if at + within + BUSY_S < self.until:
            self.until, self.why = at + within + BUSY_S, why


def problems(presses: list[Press], motors: Motors, now: float) -> Iterator[str]:
    """One line for each motion that no living input explains; ``now`` ends the last one."""
    for index, (began, wheels) in enumerate(motors):
        ended = motors[index + 1][0] if index + 1 < len(motors) else now
        moments = {began, *(one.until + _EPS for one in presses if began < one.until + _EPS < ended)}
        for at in sorted(moments if wheels != (0.0, 0.0) else ()):
            alive = [one for one in presses if one.began - _EPS <= at <= one.until]
            if not _explained(wheels, [one.axes for one in alive]):
                ends = ", ".join(f"tab {one.tab} {one.name}: {one.why}" for one in presses if one.began < at)
                yield f"{at:.3f}: wheels {wheels} until {ended:.3f}; alive: {len(alive)} ({ends or 'no input'})"
                break


def _explained(wheels: tuple[float, float], axes: list[tuple[int, int]]) -> bool:
    """Whether some of these inputs together turn each wheel so; one at rest needs no explanation."""
    for count in range(1, len(axes) + 1):
        for chosen in combinations(axes, count):
            x, z = sum(one[0] for one in chosen), sum(one[1] for one in chosen)
            if all(speed == 0 or speed * wanted > 0 for speed, wanted in zip(wheels, (z + x, z - x), strict=True)):
                return True
    return False
