"""Random schedules of real services in virtual time: ``python -m tests.kit.schedules services``.

Of one motor owner, persons and scripts; and of two owners, drivers, a bridge and stops, also with groups of commands.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.kit.schedules import Engine, Outcome, RandomSteps, Steps, perform_steps
from tests.robot.lockstep import two_owners
from tests.robot.lockstep.rest import rest
from tests.robot.lockstep.two_owners import TwoOwners
from tests.robot.lockstep.world import Folder, World

_PEOPLE = {
    "wait": 30, "drive": 4, "tap": 2, "steer": 10, "release": 5, "halt": 4, "press": 3, "nameless": 1, "reset": 4,
    "start": 16, "end": 5, "pretend": 3, "junk": 2, "retain": 2, "by_hand": 1, "end_by_hand": 1, "repeat": 2,
}  # fmt: skip
_FAULTS = {
    "wait": 30, "steer": 5, "release": 3, "halt": 3, "press": 2, "reset": 3, "start": 12, "end": 4, "retain": 2,
    "kill": 8, "freeze": 8, "gap": 2, "outage": 3, "lose": 5, "pretend": 1,
}  # fmt: skip
_DELAYS = {
    "wait": 30, "drive": 4, "steer": 8, "release": 4, "halt": 3, "tap": 6, "press": 2, "reset": 3, "start": 10,
    "end": 4, "delay": 10, "slow": 8, "repeat": 6, "freeze": 3, "lose": 2, "gap": 1,
}  # fmt: skip
_STARTS = {
    "wait": 24, "start": 24, "end": 10, "kill": 6, "freeze": 5, "steer": 3, "halt": 2, "press": 2, "reset": 3,
    "slow": 3, "delay": 3, "repeat": 4, "retain": 2, "lose": 2, "by_hand": 2, "end_by_hand": 1,
}  # fmt: skip


_SCRIPTS = RandomSteps(
    *(_PEOPLE, _FAULTS, _DELAYS, _STARTS),
    length=30,
    layouts=72,  # ends times configs
    begin=[("start", 4, None), ("wait", 0, 9)],
)


@contextmanager
def _shared(kind: str) -> Iterator[tuple[str, Any]]:
    """What schedules share: parsed configs."""
    if kind == "scripts":
        yield kind, Folder()
    else:
        with two_owners.configs(groups=kind == "groups") as configs:
            yield kind, configs


def _perform(made: tuple[str, Any], schedule: Steps) -> Outcome:
    kind, configs = made
    layout, steps = schedule
    world = World(layout, configs) if kind == "scripts" else TwoOwners(layout, configs)
    perform_steps(world, steps)
    if isinstance(world, World):
        rest(world)
    else:
        world.rest()
    return Outcome()


ENGINE = Engine(
    draw=lambda kind, seed, number: (_SCRIPTS if kind == "scripts" else two_owners.STEPS)(kind, seed, number),
    world=_shared,
    perform=_perform,
    kinds=("scripts", "owners", "groups"),
)
