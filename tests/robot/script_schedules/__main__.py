"""Runs random schedules of scripts and faults with a real robot: ``python -m tests.robot.script_schedules``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

from tests.robot.script_schedules.schedules import make
from tests.robot.script_schedules.world import World

PER_WORLD = 20  # schedules, then brokers, robot and MCU begin anew


def perform(transport: str, seeds: list[int]) -> Iterator[tuple[int, list[str], str]]:
    """Seed, what was violated, and the log if anything was, of each schedule; after a violation in a new world."""
    while seeds:
        world = World(transport)
        try:
            for _ in range(min(PER_WORLD, len(seeds))):
                seed = seeds.pop(0)
                found = world.perform(make(transport, seed))
                yield seed, found, _described(world) if found else ""
                if found:
                    break
        finally:
            world.close()


def _described(world: World) -> str:
    """What persons did and what the MCU received, in the order of time, and the end of the log."""
    began = world.history.began
    events = [(event.at, f"{event.what} {event.details or ''}") for event in world.history.events()]
    events += [(at, f"    M {wheels}") for at, wheels in world.rig.mcu.drives(began)]
    return "\n".join([*(f"{at:.3f} {text}" for at, text in sorted(events)), world.logs()])


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.script_schedules", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt"), required=True)
    parser.add_argument("--schedules", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="of the first schedule")
    options = parser.parse_args()
    began, violated = time.monotonic(), 0
    seeds = list(range(options.seed, options.seed + options.schedules))
    for number, (seed, found, log) in enumerate(perform(options.transport, seeds), 1):
        violated += bool(found)
        print(f"{number:>4}/{options.schedules} seed {seed}", *found, log, sep="\n     " if found else " ", flush=True)
    print(f"{options.transport}, {options.schedules} schedules from seed {options.seed}, {violated} with a violation,"
          f" {time.monotonic() - began:.0f} s")  # fmt: skip
    return 1 if violated else 0


if __name__ == "__main__":
    sys.exit(main())
