"""Runs random schedules in virtual time: ``python -m tests.web.driving_lockstep --schedules 10000``."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections import Counter

from tests.web.driving_lockstep.mutations import MUTATIONS
from tests.web.driving_lockstep.schedules import first_violation, generate, shortest, violation
from tests.web.driving_lockstep.world import Rig


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.web.driving_lockstep", description=__doc__)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--all", action="store_true", help="go on after a violation, and count them by their rules")
    parser.add_argument("--mutations", nargs="?", const="", help="put each bug of mutations.py in, and find it")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)
    if options.mutations is not None:
        return _mutations(options)
    broken = Counter[str]()
    began = time.monotonic()
    with Rig() as rig:
        for number in range(options.first, options.first + options.schedules):
            schedule = generate(options.seed, number)
            if rule := violation(schedule, rig):
                broken[rule] += 1
                if broken[rule] == 1:
                    layout, steps = shortest(schedule, rule, rig)
                    print(f"seed {options.seed}, schedule {number}: {rule}\nSCHEDULE = ({layout}, [")
                    print(*(f"    {step}," for step in steps), "])", sep="\n", flush=True)
                if not options.all:
                    return 1
            if number % 1000 == 999:
                print(
                    f"{number + 1} schedules, {time.monotonic() - began:.0f} s, {sum(broken.values())} violations",
                    flush=True,
                )
    for rule, times in broken.most_common():
        print(f"{times:>6}  {rule}")
    return 1 if broken else 0


def _mutations(options: argparse.Namespace) -> int:
    chosen = {name: mutation for name, mutation in MUTATIONS.items() if options.mutations in name}
    missed = 0
    for name, mutation in chosen.items():
        with mutation.applied() as folder, Rig(folder) as rig:
            found = first_violation(options.seed, options.schedules, rig, mutation.schedule)
        missed += found is None
        print(f"{name}: {'NOT FOUND' if found is None else f'schedule {found[0]}, {found[1]}'}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} found")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
