"""Random schedules, whether one violates a rule, and the shortest one that does."""

from __future__ import annotations

import random
from itertools import accumulate

from tests.motion.histories import shrink
from tests.web.driving_lockstep.rest import rest
from tests.web.driving_lockstep.world import Rig, Step, World

STEPS = 30  # of one schedule
LAYOUTS = 84

Schedule = tuple[int, list[Step]]

_HANDS = {
    "wait": 40, "press": 16, "release": 12, "tap": 6, "stick": 8, "cancel": 2, "hold": 2, "slide": 3, "pad": 8,
    "lose_pad": 1, "space": 3, "meta": 3, "blur": 6, "hide": 4, "event": 3, "dialog": 2, "block": 5, "take": 4,
    "give": 1, "select": 1,
}  # fmt: skip
_NET = {
    "wait": 40, "press": 16, "release": 10, "tap": 4, "stick": 4, "pad": 3, "slide": 1, "space": 2, "blur": 1,
    "delay": 8, "stall": 10, "break": 5, "block": 5, "suspend": 4, "clock": 2, "take": 6, "reload": 2,
}  # fmt: skip
_SERVERS = {
    "wait": 40, "press": 16, "release": 10, "stick": 4, "pad": 3, "space": 2, "take": 8, "freeze": 8, "kill": 4,
    "outage": 4, "lose": 4, "owner": 2, "slow": 2, "stall": 3, "block": 3, "silent": 2, "role": 1, "estop": 1,
    "reset": 2,
}  # fmt: skip
_LEASES = {
    "wait": 40, "press": 18, "release": 10, "tap": 4, "stick": 4, "space": 5, "take": 16, "give": 5, "other": 5,
    "select": 2, "reload": 4, "break": 3, "estop": 3, "reset": 5, "role": 2, "delay": 3, "block": 2, "blur": 2,
}  # fmt: skip
_MIXES = [(list(one), list(accumulate(one.values()))) for one in (_HANDS, _NET, _SERVERS, _LEASES)]


def generate(seed: int, number: int) -> Schedule:
    """Schedule ``number`` of ``seed``: the layout of its world, and the steps. Mostly it begins with a drive."""
    chance = random.Random(seed << 40 | number)
    names, totals = _MIXES[number % len(_MIXES)]
    steps = [
        (name, chance.randrange(8), chance.randrange(64)) for name in chance.choices(names, cum_weights=totals, k=STEPS)
    ]
    begin: list[Step] = [
        ("take", 0, 0),
        ("wait", 0, 5),
        ("press", 0, chance.randrange(64)),
        ("wait", 0, chance.randrange(64)),
    ]
    return chance.randrange(LAYOUTS), begin + steps if chance.random() < 0.8 else steps


def violation(schedule: Schedule, rig: Rig) -> str:
    """The rule that is violated in this schedule; empty if none is."""
    layout, steps = schedule
    world = None
    try:
        world = World(layout, rig)
        world.perform(steps)
        rest(world)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        if world is not None:
            world.end()
    return ""


def shortest(schedule: Schedule, broken: str, rig: Rig) -> Schedule:
    """``schedule``, which violates the rule ``broken``, without what does not matter for it."""
    return shrink(schedule, lambda shorter: violation(shorter, rig) == broken)


def first_violation(seed: int, schedules: int, rig: Rig, first: int = 0) -> tuple[int, str] | None:
    """The first of so many schedules that violates a rule, and the rule; ``first`` is tried before the others."""
    found = ((number, violation(generate(seed, number), rig)) for number in (first, *range(schedules)))
    return next(((number, rule) for number, rule in found if rule), None)
