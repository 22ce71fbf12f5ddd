"""Faults of a whole robot in a random order: ``python -m tests.robot.soak --transport zenoh --minutes 30``.

Besides those of tests/robot/faults.py its disks are full, its clock jumps, and its broker is restored from an older
save. After each the memory of each process is measured: what leaks is seen without kills, with ``--no-kills``.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import signal
import struct
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from subprocess import CalledProcessError

from rich.console import Console

from tests.own_memory import own_mb
from tests.robot import faults
from tests.robot.faults import FLOODS, Drive, Fault, flooding
from tests.robot.rig import Rig, descendants, restore, saved_by
from tests.small_disk import SmallDisk
from tests.support import Broker, process_name, quarters

_PAUSE_S = 1.5  # without commands, after each fault
_GROWS = 1.10, 2.0  # a process does, if it takes more than so many times as much, and more than so many MB
_MOST_MB = 30.0  # more than at first: what one flood may take
#: Python imports it at the start of each process of the robot. Zenoh's own clock does not jump.
_CLOCK = """\
import mmap, os, struct, time

with open(os.environ["SOAK_CLOCK"], "r+b") as file:
    ahead = mmap.mmap(file.fileno(), 8)
clock, clock_ns = time.time, time.time_ns
time.time_ns = lambda: clock_ns() + struct.unpack("q", ahead)[0]
time.time = lambda: clock() + struct.unpack("q", ahead)[0] / 1e9
"""
FAULTS = faults.FAULTS | {
    f"a flood of {name}": Fault(lambda rig, name=name: flooding(name, rig.remote.port, 3.0), 3.0)  # type: ignore[misc]
    for name in FLOODS
}


class Soak:
    """A robot at a broker that saves, with small disks of its own and a clock that can jump."""

    def __init__(self, transport: str, opened: ExitStack) -> None:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="pbl")))
        (folder / "clock").write_bytes(bytes(8))
        (folder / "sitecustomize.py").write_text(_CLOCK)
        os.environ |= {"SOAK_CLOCK": str(folder / "clock"), "PYTHONPATH": str(folder)}
        with (folder / "clock").open("r+b") as clock:
            self._ahead = mmap.mmap(clock.fileno(), 8)
        self.remote = Broker(folder, persistence=True, autosave=False)
        self.rig = opened.enter_context(
            Rig(transport, mcu="fred", start=False, remote=self.remote, listens="outgoing/#")
        )
        opened.callback(self.rig.ensure_stopped)
        self._disks = [SmallDisk(self.rig.folder / name, mebibytes=8) for name in ("run", "state")]
        for disk in self._disks:
            with suppress(CalledProcessError):
                disk.mount("mode=700")
                opened.enter_context(closing(disk))
        self.rig.start()
        self.faults = FAULTS | {
            "a clock a day ahead": Fault(partial(self._jump, 86_400), 3.0),
            "a clock an hour behind": Fault(partial(self._jump, -3_600), 3.0),
            "full disks": Fault(self._full, 3.0),
            "a broker of before": Fault(self._restored),
        }
        del self.faults["the run directory is removed"]  # here it is a disk
        self._older = saved_by(self.remote)

    @property
    def processes(self) -> dict[str, int]:
        pids = {self.rig.launcher_pid, *descendants(self.rig.launcher_pid)}
        return self.rig.processes() | {process_name(pid): pid for pid in pids - {*self.rig.processes().values()}}

    @contextmanager
    def _jump(self, seconds: int, _rig: Rig) -> Iterator[None]:
        self._ahead[:] = struct.pack("q", seconds * 10**9)
        yield
        self._ahead[:] = bytes(8)

    @contextmanager
    def _full(self, _rig: Rig) -> Iterator[None]:
        with ExitStack() as ends:
            for disk in self._disks:
                ends.enter_context(disk.full())
            yield

    @contextmanager
    def _restored(self, _rig: Rig) -> Iterator[None]:
        newer = saved_by(self.remote)
        self.remote.kill()
        restore(self._older)
        yield
        self.remote.start()
        self._older = newer


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
    parser.add_argument("--only", default="", metavar="WORDS", help="the faults with these words in their names")
    parser.add_argument("--no-kills", action="store_true", help="so that processes grow old, and what leaks is seen")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    terminal, chance, wrong = Console(), random.Random(options.seed), 0
    memory: dict[str, list[float]] = defaultdict(list)
    with ExitStack() as opened:
        soak = Soak(options.transport, opened)
        names = [name for name in soak.faults if options.only in name]
        names = [name for name in names if not (options.no_kills and "killed" in name)]
        end = time.monotonic() + 60 * options.minutes
        for name in _in_random_order(names, chance):
            if time.monotonic() > end:
                break
            soak.rig.wait_until_up(0.0)
            soak.rig.mcu.forget()
            logged, began = soak.rig.log.stat().st_size, time.monotonic()
            drive, problem = Drive(soak.rig, turns_s=soak.faults[name].turns_s), ""
            try:
                soak.faults[name].perform(soak.rig, drive)
            except AssertionError as error:
                wrong, problem = wrong + 1, f"WRONG {error}"
            bytes_s = (soak.rig.log.stat().st_size - logged) / (time.monotonic() - began)
            terminal.print(
                f"{options.transport}, {name}: driven again after {drive.back_s:.2f} s, oldest command"
                f" {drive.age_s:.2f} s, log {bytes_s:.0f} B/s {problem}",
                highlight=False,
            )
            time.sleep(_PAUSE_S)
            for program, pid in soak.processes.items():
                memory[program].append(own_mb(pid))
    growing = grown(memory, killed=not options.no_kills) if options.minutes >= 5 else []
    terminal.print(f"seed {options.seed}: {wrong} with something wrong; grown: {', '.join(growing) or 'no process'}")
    return 1 if wrong or growing else 0


if __name__ == "__main__":
    sys.exit(main())
