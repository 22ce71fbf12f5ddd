"""Random schedules: what persons do with scripts, and what fails meanwhile."""

from __future__ import annotations

import random
from dataclasses import dataclass

FILES = ("cruise", "follow", "stubborn", "busy")
FAULTS = (
    *("kill script", "kill script", "freeze script", "kill autonomy_manager", "freeze autonomy_manager"),
    *("kill serial_mcu_bridge", "freeze serial_mcu_bridge", "kill mqtt_bridge", "kill launcher"),
)
_PEOPLE = ("drive", "release", "lose", "halt", "end", "start", "estop", "reset")
_WEIGHTS = (5, 4, 1, 3, 2, 5, 1, 2)
ACTIVE_S = 4.5


@dataclass(frozen=True, slots=True)
class Step:
    at: float
    what: str
    file: str = ""
    seconds: float = 0.0  # a process that is frozen stays so


@dataclass(frozen=True, slots=True)
class Schedule:
    transport: str
    seed: int
    steps: tuple[Step, ...]


def make(transport: str, seed: int) -> Schedule:
    """The schedule of a seed; it begins with a script."""
    chance = random.Random(f"{transport} {seed}")
    steps = [Step(0.0, "start", chance.choice(FILES[:3]))]
    for _ in range(chance.randrange(4, 8)):
        what = chance.choices(_PEOPLE, _WEIGHTS)[0]
        steps.append(Step(round(chance.uniform(0.2, ACTIVE_S), 3), what, chance.choice(FILES)))
    for _ in range(chance.choice((0, 1, 1, 2))):
        what, seconds = chance.choice(FAULTS), chance.choice((0.2, 0.6, 1.5))
        steps.append(Step(round(chance.uniform(0.8, ACTIVE_S - 1.0), 3), what, "", seconds))
    return Schedule(transport, seed, tuple(sorted(steps, key=lambda step: step.at)))
