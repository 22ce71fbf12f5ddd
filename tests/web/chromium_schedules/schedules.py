"""Random schedules: what happens at two tabs of one robot's page, and what fails meanwhile."""

from __future__ import annotations

import random
from dataclasses import dataclass

ROBOTS = ("minilamp", "fred")
KEYS = {"KeyW": (0, 1), "KeyS": (0, -1), "KeyA": (-1, 0), "KeyD": (1, 0), "ArrowUp": (0, 1)}  # x and z
ROUNDS, ROUND_S = 3, 1.2
ACTIVE_S = ROUNDS * ROUND_S
_INPUTS = ("press", "press", "stick")
#: What ends a gesture, and how often.
_BY_PERSONS = {"release": 2, "drop stick": 1, "blur": 3, "hide": 3, "menu": 2, "space": 2, "reload": 1, "give back": 1}
_BY_OTHERS = {"other takes": 3, "other's space": 2, "stop": 1, "other stops": 2}
_BY_FAULTS = {"stall": 5, "cut": 3, "busy": 4, "freeze": 3, "suspend server": 4, "kill server": 1}
_INTERRUPTIONS = _BY_PERSONS | _BY_OTHERS | _BY_FAULTS
#: What makes driving possible again while the input is still held.
_REMEDIES = {"hide": "show", "stop": "reset", "other stops": "reset", "other takes": "take", "give back": "take"}
_FURTHER = (
    "press",
    "press",
    "release",
    "stick",
    "drop stick",
    "blur",
    "space",
    "take",
    "other drives",
    "other's space",
)
_FAULTS = ("stall", "busy", "freeze", "suspend server")
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
    """The schedule of a seed: each round has an input, an interruption, what makes driving possible, and a release."""
    chance = random.Random(f"page {seed}")
    steps: list[Step] = []
    for number in range(ROUNDS):
        began = number * ROUND_S + chance.uniform(0.0, 0.1)
        what = chance.choices(list(_INTERRUPTIONS), list(_INTERRUPTIONS.values()))[0]
        steps.append(_step(chance, began, chance.choice(_INPUTS)))
        steps.append(_step(chance, began + chance.uniform(0.15, 0.4), what))
        if what in _REMEDIES:
            steps.append(_step(chance, began + chance.uniform(0.5, 0.7), _REMEDIES[what]))
        steps += [
            _step(chance, began + chance.uniform(0.0, ROUND_S), one)
            for one in chance.sample(_FURTHER, chance.choice((0, 0, 1, 2)))
        ]
        steps += [_step(chance, began + ROUND_S - 0.15, one) for one in chance.sample(("release", "drop stick"), 2)]
    return Schedule(seed, ROBOTS[seed % 2], tuple(sorted(steps, key=lambda step: step.at)))


def _step(chance: random.Random, at: float, what: str) -> Step:
    key = chance.choice(list(KEYS))
    axes = chance.choice(((0, 1), (0, -1), (1, 0), (-1, 0))) if what == "stick" else KEYS[key]
    seconds = chance.choice(_LASTS_S) if what in _FAULTS else 0.0
    return Step(round(at, 3), what, key, axes, seconds)
