"""Random schedules: what happens at two tabs of one robot's page, and what fails meanwhile."""

from __future__ import annotations

import random
from dataclasses import dataclass

ROBOTS = ("minilamp", "fred")
KEYS = {"KeyW": (0, 1), "KeyS": (0, -1), "KeyA": (-1, 0), "KeyD": (1, 0), "ArrowUp": (0, 1)}  # x and z
ACTIVE_S = 3.0
_STEPS = {
    "press": 9,
    "release": 5,
    "stick": 4,
    "drop stick": 2,
    "blur": 1,
    "hide": 1,
    "show": 2,
    "menu": 1,
    "space": 1,
    "reload": 1,
    "take": 2,
    "give back": 1,
    "other takes": 2,
    "other drives": 2,
    "other's space": 2,
    "stop": 1,
    "other stops": 1,
    "reset": 3,
}
_FAULTS = {"stall": 4, "cut": 2, "busy": 3, "freeze": 2, "suspend server": 3, "kill server": 1}
_LASTS_S = (0.15, 0.4, 0.9, 1.6)


@dataclass(frozen=True, slots=True)
class Step:
    """``seconds`` is how long a fault lasts; ``axes`` are steering and throttle of an input, each -1, 0 or 1."""

    at: float
    what: str
    key: str = ""
    axes: tuple[int, int] = (0, 0)
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Schedule:
    seed: int
    robot: str
    steps: tuple[Step, ...]


def make(seed: int) -> Schedule:
    """The schedule of a seed; it begins with a key, so that something moves."""
    chance = random.Random(f"page {seed}")
    steps = [_input(chance, 0.0, "press")]
    for _ in range(chance.randrange(6, 13)):
        what = chance.choices(list(_STEPS), list(_STEPS.values()))[0]
        steps.append(_input(chance, chance.uniform(0.05, ACTIVE_S), what))
    for _ in range(chance.choice((0, 1, 1, 2))):
        what = chance.choices(list(_FAULTS), list(_FAULTS.values()))[0]
        at, seconds = chance.uniform(0.2, ACTIVE_S - 1.0), chance.choice(_LASTS_S)
        steps.append(Step(round(at, 3), what, seconds=seconds))
    return Schedule(seed, ROBOTS[seed % 2], tuple(sorted(steps, key=lambda step: step.at)))


def _input(chance: random.Random, at: float, what: str) -> Step:
    key = chance.choice(list(KEYS))
    axes = chance.choice(((0, 1), (0, -1), (1, 0), (-1, 0))) if what == "stick" else KEYS[key]
    return Step(round(at, 3), what, key, axes)
