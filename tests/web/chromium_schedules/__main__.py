"""Runs random schedules in Chromium: ``python -m tests.web.chromium_schedules``."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Iterator
from typing import Any

from tests.web.chromium_schedules.schedules import ROBOTS, make
from tests.web.chromium_schedules.world import World

PER_WORLD = 40  # schedules, then robot, server and browser begin anew

Result = tuple[int, list[str], str]


def perform(robot: str, seeds: list[int]) -> Iterator[Result]:
    """Seed, what was violated, and the log if anything was, of each schedule of this robot; then in a new world."""
    while seeds:
        world = World(robot)
        try:
            for _ in range(min(PER_WORLD, len(seeds))):
                seed = seeds.pop(0)
                began = time.monotonic()
                try:
                    found = world.perform(make(seed))
                except Exception as error:  # the next schedules need a new world
                    found = [f"{type(error).__name__}: {error}"]
                yield seed, found, _log(world, began) if found else ""
                if found:
                    break
        finally:
            world.close()


def _log(world: World, began: float) -> str:
    """What happened and what the motors did, in the order of time."""
    events = [*world.events, *((at, f"    motors {wheels}") for at, wheels in world.motors(began))]
    return "\n".join(f"{at:.3f} {text}" for at, text in sorted(events))


def _work(robot: str, seeds: list[int], results: Any) -> None:
    try:
        for result in perform(robot, seeds):
            results.put(result)
    finally:
        results.put(None)


def _parallel(seeds: list[int]) -> Iterator[Result]:
    """One process for each robot, because the server of a stage is suspended as a whole."""
    context = multiprocessing.get_context("fork")  # nothing runs yet
    results = context.Queue()
    parts = [[seed for seed in seeds if make(seed).robot == robot] for robot in ROBOTS]
    workers = [
        context.Process(target=_work, args=(robot, part, results))
        for robot, part in zip(ROBOTS, parts, strict=True)
        if part
    ]
    for worker in workers:
        worker.start()
    running = len(workers)
    while running:
        result = results.get()
        running -= result is None
        if result is not None:
            yield result
    for worker in workers:
        worker.join()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.web.chromium_schedules", description=__doc__)
    parser.add_argument("--schedules", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the first schedule")
    options = parser.parse_args()
    began, done, violated = time.monotonic(), 0, 0
    seeds = list(range(options.seed, options.seed + options.schedules))
    for done, (seed, found, log) in enumerate(_parallel(seeds), 1):
        violated += bool(found)
        print(f"{done:>4}/{options.schedules} seed {seed}", *found, log, sep="\n     " if found else " ", flush=True)
    seconds = time.monotonic() - began
    print(f"{done} schedules from seed {options.seed}, {violated} with a violation, {seconds:.0f} s")
    return 1 if violated or done < options.schedules else 0


if __name__ == "__main__":
    sys.exit(main())
