"""Runs random schedules in virtual time: ``python -m tests.robot.lockstep --schedules 10000``."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections import Counter

from tests.robot.lockstep.mutations import MUTATIONS
from tests.robot.lockstep.schedules import first_violation, generate, shortest, violation
from tests.robot.lockstep.world import Folder


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.lockstep", description=__doc__)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="go on after a violation, and count them by their rules")
    parser.add_argument("--mutations", action="store_true", help="put each bug of mutations.py in, and find it")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)
    if options.mutations:
        return _mutations(options)
    folder, broken = Folder(), Counter[str]()
    began = time.monotonic()
    for number in range(options.schedules):
        schedule = generate(options.seed, number)
        if rule := violation(schedule, folder):
            broken[rule] += 1
            if broken[rule] == 1:
                layout, steps = shortest(schedule, rule, folder)
                print(f"seed {options.seed}, schedule {number}: {rule}\nSCHEDULE = ({layout}, [")
                print(*(f"    {step}," for step in steps), "])", sep="\n", flush=True)
            if not options.all:
                return 1
        if number % 1000 == 999 or number == options.schedules - 1:
            took = time.monotonic() - began
            print(f"{number + 1} schedules, {took:.0f} s, {sum(broken.values())} with a violation", flush=True)
    for rule, times in broken.most_common():
        print(f"{times:>6}  {rule}")
    return 1 if broken else 0


def _mutations(options: argparse.Namespace) -> int:
    missed = 0
    for name, mutation in MUTATIONS.items():
        with mutation.applied():
            found = first_violation(options.seed, options.schedules, mutation.schedule)
        missed += found is None
        print(f"{name}: {'NOT FOUND' if found is None else f'schedule {found[0]}, {found[1]}'}", flush=True)
    print(f"{len(MUTATIONS) - missed} of {len(MUTATIONS)} found")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
