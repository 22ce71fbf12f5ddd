"""Faults of a whole robot in a random order: ``python -m tests.robot.soak --transport zenoh --minutes 30``.

They are those of tests/robot/faults.py. After each the memory of each process is measured: what leaks is seen without
kills, with ``--no-kills``.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Iterator

from rich.console import Console

from tests.own_memory import own_mb
from tests.robot.faults import FAULTS, Drive
from tests.robot.rig import Rig, descendants
from tests.support import process_name, quarters

_PAUSE_S = 1.5  # without commands, after each fault
_GROWS = 1.10, 2.0  # a process does, if it takes more than so many times as much, and more than so many MB
_MOST_MB = 30.0  # more than at first


def processes(rig: Rig) -> dict[str, int]:
    pids = {rig.launcher_pid, *descendants(rig.launcher_pid)}
    return rig.processes() | {process_name(pid): pid for pid in pids - {*rig.processes().values()}}


def _in_random_order(names: list[str], chance: random.Random) -> Iterator[str]:
    """Yield all names again and again: a program that is killed at each fault is restarted later and later."""
    while True:
        yield from chance.sample(names, len(names))


def grown(memory: dict[str, list[float]], *, killed: bool) -> list[str]:
    """Return which programs take too much.

    A process that is ``killed`` now and then does not grow old: what counts is that it never takes much more than at
    first. Else the last quarter is compared with the second one. In the first one tables of topics fill up.
    """
    if killed:
        return [name for name, values in memory.items() if max(values) > values[0] + _MOST_MB]
    factor, least = _GROWS
    halves = {name: quarters(values)[1::2] for name, values in memory.items()}
    return [name for name, (before, after) in halves.items() if after > max(factor * before, before + least)]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.soak", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt"), required=True)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-kills", action="store_true", help="so that processes grow old, and what leaks is seen")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    terminal, chance, wrong = Console(), random.Random(options.seed), 0
    memory: dict[str, list[float]] = defaultdict(list)
    names = [name for name in FAULTS if not (options.no_kills and "killed" in name)]
    end = time.monotonic() + 60 * options.minutes
    with Rig(options.transport, mcu="fred") as rig:
        for name in _in_random_order(names, chance):
            if time.monotonic() > end:
                break
            rig.wait_until_up(0.0)
            rig.mcu.forget()
            drive, problem = Drive(rig, turns_s=FAULTS[name].turns_s), ""
            try:
                FAULTS[name].perform(rig, drive)
            except AssertionError as error:
                wrong, problem = wrong + 1, f"WRONG {error}"
            timing = f"driven again after {drive.back_s:.2f} s, oldest command {drive.age_s:.2f} s"
            terminal.print(f"{options.transport}, {name}: {timing} {problem}", highlight=False)
            time.sleep(_PAUSE_S)
            for program, pid in processes(rig).items():
                memory[program].append(own_mb(pid))
    growing = grown(memory, killed=not options.no_kills) if options.minutes >= 5 else []
    terminal.print(f"seed {options.seed}: {wrong} with something wrong; grown: {', '.join(growing) or 'no process'}")
    return 1 if wrong or growing else 0


if __name__ == "__main__":
    sys.exit(main())
