"""Random schedules, whether one violates a rule, and the shortest one that does."""

from __future__ import annotations

import random
from itertools import accumulate

from tests.motion.histories import shrink
from tests.robot.lockstep.rest import rest
from tests.robot.lockstep.world import Folder, Step, World

STEPS = 30  # of one schedule
LAYOUTS = 72  # ends times configs

Schedule = tuple[int, list[Step]]

_PEOPLE = {
    "wait": 30,
    "drive": 4,
    "tap": 2,
    "steer": 10,
    "release": 5,
    "halt": 4,
    "press": 3,
    "nameless": 1,
    "reset": 4,
    "start": 16,
    "end": 5,
    "pretend": 3,
    "junk": 2,
    "retain": 2,
    "by_hand": 1,
    "end_by_hand": 1,
    "repeat": 2,
}
_FAULTS = {
    "wait": 30,
    "steer": 5,
    "release": 3,
    "halt": 3,
    "press": 2,
    "reset": 3,
    "start": 12,
    "end": 4,
    "retain": 2,
    "kill": 8,
    "freeze": 8,
    "gap": 2,
    "outage": 3,
    "lose": 5,
    "pretend": 1,
}
_DELAYS = {
    "wait": 30,
    "drive": 4,
    "steer": 8,
    "release": 4,
    "halt": 3,
    "tap": 6,
    "press": 2,
    "reset": 3,
    "start": 10,
    "end": 4,
    "delay": 10,
    "slow": 8,
    "repeat": 6,
    "freeze": 3,
    "lose": 2,
    "gap": 1,
}
_STARTS = {
    "wait": 24,
    "start": 24,
    "end": 10,
    "kill": 6,
    "freeze": 5,
    "steer": 3,
    "halt": 2,
    "press": 2,
    "reset": 3,
    "slow": 3,
    "delay": 3,
    "repeat": 4,
    "retain": 2,
    "lose": 2,
    "by_hand": 2,
    "end_by_hand": 1,
}
_MIXES = [(list(weights), list(accumulate(weights.values()))) for weights in (_PEOPLE, _FAULTS, _DELAYS, _STARTS)]


def generate(seed: int, number: int) -> Schedule:
    """Schedule ``number`` of ``seed``: the layout of its world, and the steps. It begins with a script, mostly."""
    chance = random.Random(seed << 40 | number)
    names, totals = _MIXES[number % len(_MIXES)]
    actions = chance.choices(names, cum_weights=totals, k=STEPS)
    steps = [(action, chance.randrange(8), chance.randrange(64)) for action in actions]
    begin = [("start", 4, chance.randrange(64)), ("wait", 0, 9)]
    return chance.randrange(LAYOUTS), begin + steps if chance.random() < 0.8 else steps


def violation(schedule: Schedule, folder: Folder) -> str:
    """The rule that is violated in this schedule; empty if none is."""
    layout, steps = schedule
    try:
        world = World(layout, folder)
        world.perform(steps)
        rest(world)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def shortest(schedule: Schedule, broken: str, folder: Folder) -> Schedule:
    """``schedule``, which violates the rule ``broken``, without what does not matter for it."""
    return shrink(schedule, lambda shorter: violation(shorter, folder) == broken)


def first_violation(seed: int, schedules: int, first: int = 0) -> tuple[int, str] | None:
    """The first of so many schedules that violates a rule, and the rule; ``first`` is tried before the others."""
    folder = Folder()
    found = ((number, violation(generate(seed, number), folder)) for number in (first, *range(schedules)))
    return next(((number, rule) for number, rule in found if rule), None)
