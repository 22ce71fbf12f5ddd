"""Random schedules: drawn from a seed, performed in a world with rules, and shortened.

``python -m tests.kit.schedules NAME`` runs the schedules of one of the :data:`ENGINES`. It prints the number and kind
of a schedule that violates a rule, by which the schedule can be repeated.
"""

from __future__ import annotations

import argparse
import logging
import random
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

#: The modules that declare an ENGINE, by the name on the command line.
ENGINES = {
    "motion": "tests.motion.histories",
    "services": "tests.robot.lockstep.two_owners",
    "robot": "tests.robot.whole",
}

Step = tuple[str, int, int]  # the world's method do_<action> is called with two numbers, below 8 and below 64
Steps = tuple[int, list[Step]]  # which layout the world has, and the steps


class ViolatedError(AssertionError):
    """An error: a rule does not hold in a schedule."""


def check(holds: bool, rule: str) -> None:
    """Raise :class:`ViolatedError` unless ``holds``."""
    if not holds:
        raise ViolatedError(rule)


@dataclass(frozen=True)
class Result:
    """The result of a schedule. ``counts`` are summed and printed; ``log``: what happened, if there are problems."""

    problems: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    log: str = ""
    name: str = ""  # of the schedule: its kind and number


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A runner of schedules for one kind of world. They use ``mixes``, weights by action, in turn.

    Most schedules first have the steps of ``begin``. A number of ``begin`` that is None is drawn.
    """

    mixes: Sequence[Mapping[str, int]]
    length: int  # steps of a schedule
    layouts: int = 1  # of a world
    begin: Sequence[tuple[str, int, int | None]] = ()
    world: Callable[[str], AbstractContextManager[Any]]  # of a kind
    perform: Callable[[Any, Steps], Result | None]  # one schedule; it may raise
    kinds: tuple[str, ...] = ("",)
    schedules: int = 10_000  # unless it is told otherwise
    per_world: int = 100  # schedules, then the world begins anew
    repeats: bool = True  # the same schedule violates the same rule, so it can be made short

    def draw(self, seed: int, number: int) -> Steps:
        chance = random.Random(seed << 40 | number)
        mix, numbers = self.mixes[number % len(self.mixes)], chance.randbytes(2 * self.length)
        actions = chance.choices(list(mix), list(mix.values()), k=self.length)
        steps = [(name, numbers[2 * at] & 7, numbers[2 * at + 1] & 63) for at, name in enumerate(actions)]
        begin = [(name, a, chance.randrange(64) if b is None else b) for name, a, b in self.begin]
        layout = chance.randrange(self.layouts)
        return layout, begin + steps if begin and chance.random() < 0.8 else steps

    def run(self, kind: str, seed: int, numbers: Iterable[int]) -> Iterator[Result]:
        """Perform these schedules in as few worlds as possible: after a violation a new world is made."""
        waiting = deque(numbers)
        while waiting:
            with self.world(kind) as world:
                for _ in range(min(self.per_world, len(waiting))):
                    number = waiting.popleft()
                    result = self.result(world, self.draw(seed, number))
                    yield replace(result, name=f"{kind} {number}".strip())
                    if result.problems:
                        break

    def result(self, world: Any, schedule: Steps) -> Result:
        try:
            return self.perform(world, schedule) or Result()
        except Exception as error:
            return Result([f"{type(error).__name__}: {error}"])

    def shortest(self, schedule: Steps, problems: list[str], kind: str) -> Steps:
        """Return ``schedule``, which has these problems, without the steps that they do not need."""
        with self.world(kind) as world:
            return shrink(schedule, lambda shorter: self.result(world, shorter).problems == problems)


def shrink(schedule: Steps, fails: Callable[[Steps], bool], layouts: int = 10) -> Steps:
    """Return the shortest schedule that still fails. Parts are left out as long as possible, then numbers become 0."""
    layout, steps = schedule
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
    layout = next((simpler for simpler in range(layouts) if fails((simpler, steps))), layout)
    for at, (action, a, b) in enumerate(steps):
        for simpler in ((action, 0, 0), (action, a, 0), (action, 0, b)):
            if fails((layout, [*steps[:at], simpler, *steps[at + 1 :]])):
                steps = [*steps[:at], simpler, *steps[at + 1 :]]
                break
    return layout, steps


# -- the command line


def main(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    engine = _engine(options)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    kinds = [kind for kind in engine.kinds if options.kind in kind]
    each = (options.schedules or engine.schedules) // len(kinds)
    numbers = range(options.number, options.number + each)
    starts = range(0, each, engine.per_world)
    parts = [(kind, numbers[at : at + engine.per_world]) for kind in kinds for at in starts]
    rules, counts, began = Counter[str](), Counter[str](), time.monotonic()
    with ExitStack() as ends:
        mapped = ends.enter_context(ProcessPoolExecutor(options.jobs)).map if options.jobs > 1 else map
        for done, results in enumerate(mapped(partial(_part, options), parts), start=1):
            for result in results:
                rules.update(result.problems)
                counts.update(result.counts)
            print(f"{done:>6} of {len(parts)} parts, {time.monotonic() - began:.0f} s", flush=True)
    print(f"\n{options.engine}, seed {options.seed}", dict(counts))
    print(*(f"{times:>6}  {rule}" for rule, times in rules.most_common()), sep="\n")
    return 1 if rules else 0


def _engine(options: argparse.Namespace) -> Engine:
    engine: Engine = import_module(ENGINES[options.engine]).ENGINE
    return engine


def _part(options: argparse.Namespace, part: tuple[str, range]) -> list[Result]:
    """Perform schedules in as few worlds as possible, and print what is violated, with the shortest schedule."""
    logging.disable(logging.CRITICAL)
    (kind, numbers), engine, results = part, _engine(options), list[Result]()
    for number, result in zip(numbers, engine.run(kind, options.seed, numbers), strict=True):
        known = {problem for earlier in results for problem in earlier.problems}
        results.append(result)
        if not result.problems:
            continue
        print(f"seed {options.seed}, {result.name}", *result.problems, sep="\n     VIOLATION ", flush=True)
        if options.log is not None:
            options.log.mkdir(parents=True, exist_ok=True)
            (options.log / f"{options.seed} {result.name}.txt").write_text(result.log)
        if engine.repeats and not known.intersection(result.problems):
            layout, steps = engine.shortest(engine.draw(options.seed, number), result.problems, kind)
            print(f"SCHEDULE = ({layout}, [", *(f"    {step}," for step in steps), "])", sep="\n", flush=True)
    return results


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.kit.schedules", description=__doc__)
    parser.add_argument("engine", choices=ENGINES)
    parser.add_argument("--schedules", type=int, metavar="N", help="divided among the kinds of world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--number", type=int, default=0, help="of the first schedule")
    parser.add_argument("--kind", default="", help="only worlds whose kind contains this")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--log", type=Path, help="folder for what happened in schedules with a violation")
    return parser


if __name__ == "__main__":
    from tests.kit import schedules  # the module that engines know, not this copy of it

    sys.exit(schedules.main(sys.argv[1:]))
