"""Random schedules of humans at pages in virtual time: ``python -m tests.kit.schedules driving_lockstep``."""

from __future__ import annotations

import os

from tests.ext.page.driving_lockstep.rest import rest
from tests.ext.page.driving_lockstep.world import CORE, Rig, World
from tests.kit.schedules import Engine, Outcome, RandomSteps, Steps

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


def _perform(rig: Rig, schedule: Steps) -> Outcome:
    layout, steps = schedule
    world = World(layout, rig)
    try:
        world.perform(steps)
        rest(world)
    finally:
        world.end()
    return Outcome(counts={"drives": world.rules.moves})


ENGINE = Engine(
    draw=RandomSteps(
        *(_HANDS, _NET, _SERVERS, _LEASES),
        length=30,
        layouts=84,
        begin=[("take", 0, 0), ("wait", 0, 5), ("press", 0, None), ("wait", 0, None)],
    ),
    world=lambda _kind: Rig(CORE),
    perform=_perform,
    jobs=os.cpu_count() or 1,
)
