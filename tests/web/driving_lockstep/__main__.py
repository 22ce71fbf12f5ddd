"""Runs random schedules in virtual time: ``python -m tests.web.driving_lockstep --schedules 10000``."""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

from tests.web.driving_lockstep.mutations import MUTATIONS
from tests.web.driving_lockstep.schedules import first_violation, generate, shortest, violation
from tests.web.driving_lockstep.world import Rig

_TOGETHER = 100  # schedules in one process of node


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.web.driving_lockstep", description=__doc__)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--all", action="store_true", help="go on after a violation, and count them by their rules")
    parser.add_argument("--mutations", nargs="?", const="", help="put each bug of mutations.py in, and find it")
    options = parser.parse_args(arguments)
    with ProcessPoolExecutor(options.jobs) as pool:
        return _schedules(options, pool) if options.mutations is None else _mutations(options, pool)


def _schedules(options: argparse.Namespace, pool: ProcessPoolExecutor) -> int:
    broken, began, done, drives = Counter[str](), time.monotonic(), 0, 0
    firsts = range(0, options.schedules, _TOGETHER)
    parts = [range(first, min(first + _TOGETHER, options.schedules)) for first in firsts]
    for part, (found, moved) in zip(parts, pool.map(_part, [options.seed] * len(parts), parts), strict=True):
        for number, rule in found:
            broken[rule] += 1
            if broken[rule] == 1:
                _show(options.seed, number, rule)
        done, drives = done + len(part), drives + moved
        if broken and not options.all:
            pool.shutdown(cancel_futures=True)
            return 1
        if done % 500 == 0 or done == options.schedules:
            took = time.monotonic() - began
            print(f"{done} schedules, {drives} drives, {took:.0f} s, {broken.total()} with a violation", flush=True)
    for rule, times in broken.most_common():
        print(f"{times:>6}  {rule}")
    return 1 if broken else 0


def _part(seed: int, numbers: range) -> tuple[list[tuple[int, str]], int]:
    """The violations in these schedules, and how often wheels began to turn."""
    logging.disable(logging.CRITICAL)
    with Rig() as rig:
        found = [(number, rule) for number in numbers if (rule := violation(generate(seed, number), rig))]
    return found, rig.drives


def _show(seed: int, number: int, rule: str) -> None:
    logging.disable(logging.CRITICAL)
    with Rig() as rig:
        layout, steps = shortest(generate(seed, number), rule, rig)
    print(f"seed {seed}, schedule {number}: {rule}\nSCHEDULE = ({layout}, [")
    print(*(f"    {step}," for step in steps), "])", sep="\n", flush=True)


def _mutations(options: argparse.Namespace, pool: ProcessPoolExecutor) -> int:
    names = [name for name in MUTATIONS if options.mutations in name]
    missed = 0
    for name, found in zip(names, pool.map(_find, names, *_repeated(options, len(names))), strict=True):
        missed += found is None
        print(f"{name}: {'NOT FOUND' if found is None else f'schedule {found[0]}, {found[1]}'}", flush=True)
    print(f"{len(names) - missed} of {len(names)} found")
    return 1 if missed else 0


def _repeated(options: argparse.Namespace, times: int) -> tuple[list[int], list[int]]:
    return [options.seed] * times, [options.schedules] * times


def _find(name: str, seed: int, schedules: int) -> tuple[int, str] | None:
    logging.disable(logging.CRITICAL)
    mutation = MUTATIONS[name]
    with mutation.applied() as folder, Rig(folder) as rig:
        return first_violation(seed, schedules, rig, mutation.schedule)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
