"""Random schedules of real services in virtual time: ``python -m tests.kit.schedules services``.

Of two motor owners, drivers, scripts, a bridge and stops; also with groups of commands.
"""

from __future__ import annotations

from pebble.config import Config
from tests.kit.schedules import Engine, Outcome, Steps, perform_steps
from tests.robot.lockstep.two_owners import STEPS, TwoOwners, configs


def _perform(configs: tuple[Config, ...], schedule: Steps) -> Outcome:
    layout, steps = schedule
    world = TwoOwners(layout, configs)
    perform_steps(world, steps)
    world.rest()
    return Outcome()


ENGINE = Engine(
    draw=STEPS,
    world=lambda kind: configs(groups=kind == "groups"),  # what schedules share
    perform=_perform,
    kinds=("owners", "groups"),
)
