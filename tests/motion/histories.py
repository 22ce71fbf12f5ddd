"""Random histories of stops, resets and drives, and the shortest one in which a rule does not hold.

``python -m tests.motion.histories --steps 10000000``
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable
from itertools import accumulate
from typing import Any

from tests.motion.world import CORES, LAYOUTS, Step, World

STEPS = 100  # of one history

_EVERYTHING = {
    "wait": 14,
    "deliver": 16,
    "all": 10,
    "duplicate": 3,
    "lose": 2,
    "deaf": 2,
    "retain": 2,
    "subscribe": 2,
    "restore": 1,
    "drive": 6,
    "release": 3,
    "halt": 1,
    "press": 3,
    "nameless": 1,
    "see": 10,
    "reset": 3,
    "look_and_reset": 3,
    "send": 4,
    "end_sender": 1,
    "start_run": 3,
    "script": 8,
    "rogue": 2,
    "end_run": 1,
    "restart_manager": 1,
    "work": 5,
    "apply": 3,
    "write": 9,
    "cut": 2,
    "cut_all": 1,
    "cut_while_writing": 1,
    "start": 6,
    "unwritable": 1,
    "corrupt": 1,
    "remove": 1,
}
_DRIVING = {
    "wait": 30,
    "deliver": 10,
    "all": 40,
    "duplicate": 2,
    "lose": 2,
    "deaf": 1,
    "retain": 1,
    "subscribe": 1,
    "drive": 6,
    "release": 4,
    "halt": 1,
    "press": 1,
    "send": 1,
    "see": 4,
    "look_and_reset": 3,
    "start_run": 6,
    "script": 24,
    "rogue": 3,
    "end_run": 1,
    "work": 4,
    "apply": 3,
    "write": 2,
    "cut": 1,
    "start": 2,
    "restart": 4,
    "restart_manager": 2,
    "end_sender": 1,
}
_RESETTING = {
    "wait": 24,
    "deliver": 6,
    "all": 34,
    "drive": 24,
    "release": 2,
    "press": 4,
    "nameless": 3,
    "send": 3,
    "see": 10,
    "reset": 2,
    "look_and_reset": 16,
    "retain": 1,
    "subscribe": 1,
    "restore": 1,
    "write": 6,
    "cut": 1,
    "start": 2,
}
_SAVING = {
    "wait": 12,
    "deliver": 6,
    "all": 16,
    "duplicate": 3,
    "press": 5,
    "send": 4,
    "see": 16,
    "reset": 3,
    "look_and_reset": 9,
    "write": 30,
    "cut": 5,
    "cut_all": 2,
    "cut_while_writing": 2,
    "start": 10,
    "drive": 4,
    "unwritable": 2,
    "corrupt": 1,
    "remove": 1,
    "restart_manager": 1,
    "lose": 1,
    "deaf": 1,
    "retain": 1,
    "nameless": 1,
}


def _totals(weights: dict[str, int]) -> tuple[list[str], list[int]]:
    return list(weights), list(accumulate(weights.values()))


_MIXES = tuple(map(_totals, (_EVERYTHING, _DRIVING, _RESETTING, _SAVING)))

History = tuple[int, list[Step]]


def generate(seed: int, number: int) -> History:
    """History ``number`` of ``seed``: the layout of the robot, and the steps."""
    source = random.Random(seed << 40 | number)
    names, totals = _MIXES[number % len(_MIXES)]
    actions = source.choices(names, cum_weights=totals, k=STEPS)
    numbers = source.randbytes(2 * STEPS)
    steps = [(action, numbers[2 * at] & 7, numbers[2 * at + 1] & 63) for at, action in enumerate(actions)]
    return source.randrange(len(LAYOUTS)), steps


def violation(history: History, world: type[World] = World, cores: Any = CORES) -> str:
    """The rule that does not hold in this history; empty if all do."""
    layout, steps = history
    try:
        one = world(layout, cores)
        one.perform(steps)
        one.rest()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def shrink(history: History, fails: Callable[[History], bool]) -> History:
    """The shortest history that still fails: parts are left out as long as possible, then numbers become 0."""
    layout, steps = history
    size = len(steps) // 2
    while size:
        before, at = len(steps), 0
        while at < len(steps):
            shorter = steps[:at] + steps[at + size :]
            if fails((layout, shorter)):
                steps = shorter
            else:
                at += size
        if size > 1 or len(steps) == before:
            size //= 2
    layout = next((simpler for simpler in range(len(LAYOUTS)) if fails((simpler, steps))), layout)
    for at, (action, a, b) in enumerate(steps):
        for simpler in ((action, 0, 0), (action, a, 0), (action, 0, b)):
            if fails((layout, [*steps[:at], simpler, *steps[at + 1 :]])):
                steps = [*steps[:at], simpler, *steps[at + 1 :]]
                break
    return layout, steps


def shortest(history: History, broken: str, world: type[World] = World, cores: Any = CORES) -> History:
    """``history``, which breaks the rule ``broken``, without what does not matter for it."""
    return shrink(history, lambda shorter: violation(shorter, world, cores) == broken)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    began = time.monotonic()
    histories = -(-options.steps // STEPS)
    for number in range(histories):
        history = generate(options.seed, number)
        if broken := violation(history):
            layout, steps = shortest(history, broken)
            print(f"seed {options.seed}, history {number}: {broken}\nHISTORY = ({layout}, [")
            print(*(f"    {step}," for step in steps), "])", sep="\n")
            return 1
        if number % 10_000 == 9_999 or number == histories - 1:
            done, took = (number + 1) * STEPS, time.monotonic() - began
            print(f"{done} steps, {done / took:.0f} steps/s, {took:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
