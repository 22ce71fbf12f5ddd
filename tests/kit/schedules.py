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
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from itertools import accumulate, repeat
from pathlib import Path
from typing import Any

#: The modules that declare an ENGINE, by the name on the command line.
ENGINES = {
    "motion": "tests.motion.histories",
    "services": "tests.robot.lockstep.two_owners",
    "robot": "tests.robot.whole",
}

Step = tuple[str, int, int]  # the world's method do_<action> is called with two small numbers
Steps = tuple[int, list[Step]]  # which layout the world has, and the steps

_PROGRESS_S = 5.0


class ViolatedError(AssertionError):
    """An error: a rule does not hold in a schedule."""


def check(holds: bool, rule: str) -> None:
    """Raise :class:`ViolatedError` unless ``holds``."""
    if not holds:
        raise ViolatedError(rule)


def small_numbers(chance: random.Random, count: int) -> Iterable[tuple[int, int]]:
    """Return pairs of numbers below 8 and below 64, for ``count`` steps."""
    return [(chance.randrange(8), chance.randrange(64)) for _ in range(count)]


def perform_steps(world: Any, steps: list[Step]) -> None:
    for action, a, b in steps:
        getattr(world, "do_" + action)(a, b)


class RandomSteps:
    """A generator of steps. Schedules use ``mixes``, weights by action, in turn.

    Most schedules first have the steps of ``begin``. A number of ``begin`` that is None is drawn.
    """

    def __init__(
        self,
        *mixes: Mapping[str, int],
        length: int,
        layouts: int,
        begin: Sequence[tuple[str, int, int | None]] = (),
        numbers: Callable[[random.Random, int], Iterable[tuple[int, int]]] = small_numbers,
    ) -> None:
        self._mixes = [(list(weights), list(accumulate(weights.values()))) for weights in mixes]
        self._length, self._layouts, self._begin, self._numbers = length, layouts, begin, numbers

    def __call__(self, kind: str, seed: int, number: int) -> Steps:
        chance = random.Random(seed << 40 | number)
        names, totals = self._mixes[number % len(self._mixes)]
        actions = chance.choices(names, cum_weights=totals, k=self._length)
        steps = [(action, a, b) for action, (a, b) in zip(actions, self._numbers(chance, self._length), strict=True)]
        begin = [(action, a, chance.randrange(64) if b is None else b) for action, a, b in self._begin]
        layout = chance.randrange(self._layouts)
        return layout, begin + steps if begin and chance.random() < 0.8 else steps


@dataclass
class Outcome:
    """The outcome of a schedule. ``counts`` are summed and printed; ``log`` says what happened."""

    problems: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    log: Callable[[], str] = str


@dataclass(frozen=True)
class Result:
    """The result of a schedule that was performed."""

    kind: str
    number: int
    seconds: float
    problems: list[str]
    counts: dict[str, int]
    log: str

    def __str__(self) -> str:
        return f"{self.kind or 'schedule'} {self.number}"


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A runner of schedules for one kind of world."""

    draw: Callable[[str, int, int], Any]  # kind of world, seed, number
    world: Callable[[str], AbstractContextManager[Any]]  # of a kind
    perform: Callable[[Any, Any], Outcome]  # one schedule; it may raise
    kinds: tuple[str, ...] = ("",)
    schedules: int = 10_000  # unless it is told otherwise
    per_world: int = 100  # schedules, then the world begins anew
    jobs: int = 1  # processes
    repeats: bool = True  # the same schedule violates the same rule, so it can be made short

    def run(self, kind: str, seed: int, numbers: Iterable[int]) -> Iterator[Result]:
        """Perform these schedules in as few worlds as possible: after a violation a new world is made."""
        waiting = deque(numbers)
        while waiting:
            with self.world(kind) as world:
                for _ in range(min(self.per_world, len(waiting))):
                    number = waiting.popleft()
                    began = time.monotonic()
                    one = self._outcome(world, self.draw(kind, seed, number))
                    log = one.log() if one.problems else ""
                    yield Result(kind, number, time.monotonic() - began, one.problems, one.counts, log)
                    if one.problems:
                        break

    def violation(self, world: Any, schedule: Any) -> str:
        """Return the rule that is violated in this schedule; empty if there is none."""
        return next(iter(self._outcome(world, schedule).problems), "")

    def shortest(self, schedule: Steps, rule: str, kind: str = "") -> Steps:
        """Return ``schedule``, which violates the rule, without the steps that the violation does not need."""
        with self.world(kind) as world:
            return shrink(schedule, lambda shorter: self.violation(world, shorter) == rule)

    def _outcome(self, world: Any, schedule: Any) -> Outcome:
        try:
            return self.perform(world, schedule)
        except Exception as error:
            return Outcome([f"{type(error).__name__}: {error}"])


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


@contextmanager
def shared(nothing: Any = None) -> Iterator[Any]:
    """Yield a world of which schedules share nothing."""
    yield nothing


# -- the command line


def main(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    module = ENGINES[options.engine]
    engine: Engine = import_module(module).ENGINE
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    options.schedules = engine.schedules if options.schedules is None else options.schedules
    options.jobs = options.jobs or engine.jobs
    return _schedules(options, engine, module)


def _schedules(options: argparse.Namespace, engine: Engine, module: str) -> int:
    kinds = [kind for kind in engine.kinds if kind == options.kind] or [k for k in engine.kinds if options.kind in k]
    rules, counts, began, shown, number = Counter[str](), Counter[str](), time.monotonic(), 0.0, 0
    for part in _map(options.jobs, _part, repeat((module, options.seed)), _parts(options, kinds, engine)):
        for one in part:
            number += 1
            rules.update(one.problems)
            counts.update(one.counts)
            if one.problems:
                _show(options, engine, one, new=any(rules[rule] == 1 for rule in one.problems))
            took = time.monotonic() - began
            if took > shown + _PROGRESS_S or number == options.schedules:
                shown = took
                print(f"{number:>6} of {options.schedules}, {took:.0f} s: {one}, {one.seconds:.2f} s", flush=True)
    print(
        f"\n{options.engine}, seed {options.seed}, {number} schedules, {time.monotonic() - began:.0f} s", dict(counts)
    )
    print(*(f"{times:>6}  {rule}" for rule, times in rules.most_common()), sep="\n")
    return 1 if rules else 0


def _parts(options: argparse.Namespace, kinds: list[str], engine: Engine) -> Iterator[tuple[str, range]]:
    """Yield the schedules, divided among the kinds of world, in parts for one world each."""
    for index, kind in enumerate(kinds):
        share = options.schedules * (index + 1) // len(kinds) - options.schedules * index // len(kinds)
        numbers = range(options.number, options.number + share)
        yield from ((kind, numbers[at : at + engine.per_world]) for at in range(0, share, engine.per_world))


def _part(what: tuple[str, int], part: tuple[str, range]) -> Iterable[Result]:
    module, seed = what
    logging.disable(logging.CRITICAL)
    engine: Engine = import_module(module).ENGINE
    return engine.run(part[0], seed, part[1])


def _whole_part(what: tuple[str, int], part: tuple[str, range]) -> list[Result]:
    return list(_part(what, part))


def _show(options: argparse.Namespace, engine: Engine, one: Result, *, new: bool) -> None:
    print(f"seed {options.seed}, {one}", *one.problems, sep="\n     VIOLATION ", flush=True)
    if options.log is not None and one.log:
        options.log.mkdir(parents=True, exist_ok=True)
        (options.log / f"{one.kind} {options.seed} {one.number}.txt").write_text(one.log)
    elif one.log:
        print(one.log)
    if new and engine.repeats:
        layout, steps = engine.shortest(engine.draw(one.kind, options.seed, one.number), one.problems[0], one.kind)
        print(f"SCHEDULE = ({layout}, [", *(f"    {step}," for step in steps), "])", sep="\n", flush=True)


def _map(jobs: int, work: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
    if jobs == 1:
        yield from map(work, *arguments)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(_whole_part if work is _part else work, *arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.kit.schedules", description=__doc__)
    parser.add_argument("engine", choices=ENGINES)
    parser.add_argument("--schedules", type=int, metavar="N", help="divided among the kinds of world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--number", type=int, default=0, help="of the first schedule")
    parser.add_argument("--kind", default="", help="only worlds whose kind contains this")
    parser.add_argument("--jobs", type=int, help="processes")
    parser.add_argument("--log", type=Path, help="folder for what happened in schedules with a violation")
    return parser


if __name__ == "__main__":
    from tests.kit import schedules  # the module that engines know, not this copy of it

    sys.exit(schedules.main(sys.argv[1:]))
