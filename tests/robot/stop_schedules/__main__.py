"""Runs random schedules of stops and faults: ``python -m tests.robot.stop_schedules --transport zenoh``."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tests.robot.stop_schedules.performance import Performance, Result, described, wheels_described
from tests.robot.stop_schedules.schedules import make, setups
from tests.robot.stop_schedules.world import World

PER_WORLD = 10  # schedules, then brokers, robot and board begin anew


def perform(
    transport: str, setup: str, seeds: list[int], log: Path | None = None, *, verbose: bool = False
) -> Iterator[Result]:
    """The schedules of one set-up, in as few worlds as possible: after a violation in a new one."""
    while seeds:
        world = World(transport, setup)
        try:
            for _ in range(min(PER_WORLD, len(seeds))):
                result = Performance(world, make(transport, setup, seeds.pop(0))).run()
                if result.problems or verbose:
                    text = f"{described(result)}\n\n{wheels_described(world, result.history)}\n\n{world.logs()}\n"
                    if log is not None:
                        (log / f"{transport} {setup} {result.schedule.seed}.txt").write_text(text)
                    if verbose:
                        sys.stdout.write(text)
                yield result
                if result.problems:
                    break
        finally:
            world.close()


def table(results: list[Result]) -> str:
    """One line for each set-up, then one for each kind of fault."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.schedule.setup, []).append(result)
    faults: dict[str, list[Result]] = {}
    for result in results:
        for fault in result.schedule.faults:
            faults.setdefault(fault, []).append(result)
    names = ("schedules", "stops", "confirmed", "deaf", "resets", "violations", "slowest")
    head = f"{'':28}" + "".join(f"{name:>11}" for name in names)
    lines = [head, *(_line(name, group) for name, group in groups.items()), _line("all", results), "", "with the fault"]
    return "\n".join([*lines, *(_line(name, faults[name]) for name in sorted(faults))])


def _line(name: str, group: list[Result]) -> str:
    stops, confirmed = sum(r.stops for r in group), sum(r.confirmed for r in group)
    deaf, resets = sum(r.unconfirmable for r in group), sum(r.resets for r in group)
    bad, slowest = sum(len(r.problems) for r in group), max(r.slowest for r in group)
    numbers = (len(group), stops, confirmed, deaf, resets, bad, f"{slowest:.2f} s")
    return f"{name:28}" + "".join(f"{number:>11}" for number in numbers)


def main() -> int:
    options = _parser().parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    chosen = [options.setup] if options.setup else list(setups(options.transport))
    results: list[Result] = []
    began = time.monotonic()
    if options.log is not None:
        options.log.mkdir(parents=True, exist_ok=True)
    for index, setup in enumerate(chosen):
        count = options.schedules * (index + 1) // len(chosen) - options.schedules * index // len(chosen)
        seeds = [options.seed + number for number in range(count)]
        for result in perform(options.transport, setup, seeds, options.log, verbose=options.verbose):
            results.append(result)
            _progress(options, result, len(results))
            if result.problems and options.first:
                return 1
    print(f"\n{options.transport}, seed {options.seed}, {time.monotonic() - began:.0f} s\n{table(results)}")
    return 1 if any(result.problems for result in results) else 0


def _progress(options: argparse.Namespace, result: Result, number: int) -> None:
    what = f"{result.schedule.setup} --seed {result.schedule.seed}"
    print(f"{number:>4}/{options.schedules} {result.seconds:5.1f} s  {what}", flush=True)
    for problem in result.problems:
        print(f"     VIOLATION {problem}", flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.stop_schedules", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt"), required=True)
    parser.add_argument("--schedules", type=int, default=200, metavar="N", help="divided among the set-ups")
    parser.add_argument("--seed", type=int, default=1, help="of the first schedule of each set-up")
    parser.add_argument(
        "--setup", help="only this one, e.g. to repeat a schedule together with --seed and --schedules 1"
    )
    parser.add_argument("--log", type=Path, help="folder for the histories of schedules with a violation")
    parser.add_argument("--first", action="store_true", help="end at the first violation")
    parser.add_argument("--verbose", action="store_true", help="print every history")
    return parser


if __name__ == "__main__":
    sys.exit(main())
