"""Drives a whole robot while everything around it fails: ``python -m tests.robot.soak --transport zenoh --minutes 30``.

One attack after another, in a random order, each while an operator drives. Afterwards: did a command that was too old
move a wheel, did a wheel turn for too long without another one, and how long did it take until the robot could be
driven again? Between the attacks the memory of each process is measured.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

from tests.own_memory import own_mb
from tests.robot.operator import Driver, number_of
from tests.robot.rig import STOP
from tests.robot.soak.attacks import Attack, attacks, shuffled
from tests.robot.soak.world import World
from tests.support import quarters, until

AGE_S = 1.0  # no older command moves a wheel
BACK_S = 5.0  # after the end of an attack commands reach the wheels again
_PAUSE_S = 1.5  # without commands, after each attack
_NUMBERS = 2000  # of one attack's commands
_GROWS = 1.10, 2.0  # a process does, if it takes more than so many times as much, and more than so many MB
_MOST_MB = 30.0  # more than at first: what one flood may take
_LOOKS = 640_000 // _NUMBERS


@dataclass
class Outcome:
    """The times of one attack, in seconds; ``back_s`` infinite: it could not be driven."""

    name: str
    seconds: float = 0.0
    back_s: float = float("inf")
    age_s: float = 0.0  # of the oldest command that moved a wheel
    turned_s: float = 0.0  # the longest without another line
    lines: float = 0.0  # of the log, per second
    problems: list[str] = field(default_factory=list)


def perform(world: World, name: str, attack: Attack, seconds: float, first: int) -> Outcome:
    """An operator drives through it, and pauses."""
    rig, outcome = world.rig, Outcome(name)
    rig.mcu.forget()
    driver = Driver(world.operator, first=first, qos=0)
    try:
        began = time.monotonic()
        if not until(lambda: rig.mcu.moving(began), BACK_S):
            outcome.problems.append("could not be driven before it")
        logged, attacked = rig.log.stat().st_size, time.monotonic()
        attack.run(world, seconds)
        over = time.monotonic()
        outcome.seconds = over - attacked

        def back() -> bool:
            return any(driver.sent_at[number] >= over for _, number, _ in _commands(world, over))

        if until(back, 4 * BACK_S, step=0.02):
            outcome.back_s = (
                min(at for at, number, _ in _commands(world, over) if driver.sent_at[number] >= over) - over
            )
        with rig.log.open("rb") as log:
            log.seek(logged)
            outcome.lines = log.read().count(b"\n") / (time.monotonic() - attacked)
    finally:
        driver.stop()
    time.sleep(_PAUSE_S)
    _judge(world, attack, outcome, driver, began)
    return outcome


def _commands(world: World, since: float) -> list[tuple[float, int, tuple[float, float]]]:
    return [(at, number_of(*wheels), wheels) for at, wheels in world.rig.mcu.drives(since) if wheels != STOP]


def _judge(world: World, attack: Attack, outcome: Outcome, driver: Driver, began: float) -> None:
    for at, number, _ in _commands(world, began):
        outcome.age_s = max(outcome.age_s, at - driver.sent_at.get(number, float("-inf")))
    outcome.turned_s = _longest_turn(world, began)
    if outcome.back_s > BACK_S:
        outcome.problems.append(f"could be driven again after {outcome.back_s:.1f} s")
    if outcome.age_s > AGE_S:
        outcome.problems.append(f"a command moved the wheels {outcome.age_s:.2f} s after it was sent")
    if outcome.turned_s > attack.turns_s:
        outcome.problems.append(f"the wheels turned for {outcome.turned_s:.2f} s without another line")
    if world.rig.mcu.turning():
        outcome.problems.append("the wheels still turn")


def _longest_turn(world: World, began: float) -> float:
    """Seconds that the motors turned after a line until the next one, or until they stood still."""
    mcu = world.rig.mcu
    events = [(at, None) for at, _ in mcu.drives(began)] + [(at, wheels != STOP) for at, wheels in mcu.motors(began)]
    longest, turning, line = 0.0, False, began
    for at, turns in sorted(events, key=lambda one: one[0]):
        if turning:
            longest = max(longest, at - line)
        if turns is None:
            line = at
        else:
            turning = turns
    return longest


def grown(memory: dict[str, list[float]], *, killed: bool) -> list[str]:
    """Which programs take too much.

    A process that is ``killed`` now and then does not grow old, and floods leave it with more or less: what counts is
    that it never takes much more than at first. What leaks is seen without kills: the last quarter is compared with the
    second one. In the first one the bridge's tables of topics fill up: strangers may fill them.
    """
    if killed:
        return [name for name, values in memory.items() if max(values) > values[0] + _MOST_MB]
    return [name for name, values in memory.items() if _grows(*quarters(values)[1::2])]


def _grows(before: float, after: float) -> bool:
    factor, least = _GROWS
    return after > factor * before and after > before + least


def tables(outcomes: list[Outcome], memory: dict[str, list[float]]) -> list[Table]:
    by_name: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        by_name[outcome.name].append(outcome)
    found = Table("attack", "times", "driven again, s", "oldest command, s", "turned alone, s", "log lines/s", "wrong")
    for name, group in sorted(by_name.items()):
        worst = [max(getattr(one, what) for one in group) for what in ("back_s", "age_s", "turned_s", "lines")]
        wrong = sum(bool(one.problems) for one in group)
        found.add_row(name, str(len(group)), *(f"{value:.2f}" for value in worst), str(wrong))
    grew = Table("MB of", "at first", "medians of the quarters", "highest")
    for name, values in sorted(memory.items()):
        medians = " ".join(f"{value:.1f}" for value in quarters(values))
        grew.add_row(name, f"{values[0]:.1f}", medians, f"{max(values):.1f}")
    return [found, grew]


def main() -> int:
    parser = _parser()
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    terminal, chance = Console(), random.Random(options.seed)
    world = World(options.transport)
    outcomes: list[Outcome] = []
    memory: dict[str, list[float]] = defaultdict(list)
    queue: list[str] = []
    try:
        world.start()
        world.older = world.save()
        if not world.has_disks:
            terminal.print("not allowed to mount disks: none will be full")
        end = time.monotonic() + 60 * options.minutes
        while time.monotonic() < end:
            queue = queue or [name for name in shuffled(world, chance) if _chosen(name, options)]
            if not queue:
                parser.error(f"no attack is called {options.only}")
            began = time.monotonic()
            world.rig.wait_until_up(0.0)
            name = queue.pop(0)
            attack = attacks(world)[name]
            first = 1 + _NUMBERS * (len(outcomes) % _LOOKS)
            outcome = perform(world, name, attack, chance.uniform(*attack.seconds), first)
            outcomes.append(outcome)
            for program, pid in world.robot.items():
                memory[program].append(own_mb(pid))
            _report(terminal, options, outcome, time.monotonic() - began, end)
    finally:
        world.close()
    for table in tables(outcomes, memory):
        terminal.print(table)
    bad = [one for one in outcomes if one.problems]
    growing = grown(memory, killed=not options.no_kills) if options.minutes >= 5 else []
    terminal.print(
        f"{options.transport}, seed {options.seed}: {len(outcomes)} attacks, {len(bad)} with something wrong; "
        f"grown: {', '.join(growing) or 'no process'}"
    )
    return 1 if bad or growing else 0


def _chosen(name: str, options: argparse.Namespace) -> bool:
    return (options.only or "") in name and not (options.no_kills and "killed" in name)


def _report(terminal: Console, options: argparse.Namespace, outcome: Outcome, took: float, end: float) -> None:
    left = max(0.0, end - time.monotonic()) / 60
    terminal.print(
        f"{options.transport}, {left:4.1f} min left: {outcome.name}, {outcome.seconds:.1f} s of {took:.1f}: driven"
        f" again after {outcome.back_s:.2f} s, oldest command {outcome.age_s:.2f} s,"
        f" turned alone {outcome.turned_s:.2f} s",
        highlight=False,
    )
    for problem in outcome.problems:
        terminal.print(f"    WRONG {problem}", highlight=False)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.soak", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt"), required=True)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", metavar="WORDS", help="the attacks with these words in their names")
    parser.add_argument("--no-kills", action="store_true", help="so that processes grow old, and what leaks is seen")
    return parser


if __name__ == "__main__":
    sys.exit(main())
