"""Floods of a whole robot, each for ten seconds, and again while it starts.

``python -m tests.robot.soak.floods --transport zenoh``. What must hold: 95 % of the heartbeats, five of five commands
obeyed within a second, at most 30 MB more for each process, at most ten lines in the log per second.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.robot.operator import number_of, numbered
from tests.robot.rig import STOP
from tests.robot.soak.flood import FLOODS, flooding
from tests.robot.soak.world import World
from tests.support import until

NAMES = ("retained flags", "retained topics", "60 MB once a second", "actions")
_SECONDS = 10.0
_COMMANDS = 5
_HEARTBEAT_S = 0.25  # between two heartbeats
_OBEYED_S = 1.0
_START_S = 30.0
_MOST = {"heartbeats": 0.95, "mb": 30.0, "lines": 10.0}


@dataclass
class Figures:
    """Ten seconds: share of heartbeats, commands obeyed, the process that took most more, lines per second."""

    heartbeats: float
    obeyed: int
    slowest_s: float
    mb: float
    program: str
    lines: float

    @property
    def good(self) -> bool:
        enough = self.heartbeats >= _MOST["heartbeats"] and self.obeyed == _COMMANDS
        return enough and self.mb <= _MOST["mb"] and self.lines <= _MOST["lines"]


def observe(world: World, before: dict[str, float], first: int, seconds: float = _SECONDS) -> Figures:
    """Drive, and look at it, for some seconds."""
    rig, since, logged = world.rig, time.monotonic(), world.rig.log.stat().st_size
    rig.mcu.forget()
    delays, most = [], ("", 0.0)
    for index in range(_COMMANDS):
        delays.append(_delay(world, first + index))
        most = max(most, *_growth(world, before), key=lambda one: one[1])
        time.sleep(max(0.0, since + (index + 1) * seconds / _COMMANDS - time.monotonic()))
    passed = time.monotonic() - since
    heartbeats = len([one for one in world.operator.on("outgoing/online", since) if not one.retain])
    with rig.log.open("rb") as log:
        log.seek(logged)
        lines = log.read().count(b"\n") / passed
    obeyed = [delay for delay in delays if delay <= _OBEYED_S]
    return Figures(min(1.0, heartbeats / (passed / _HEARTBEAT_S)), len(obeyed), max(delays), most[1], most[0], lines)


def _delay(world: World, number: int) -> float:
    """Seconds until the MCU receives a command; infinite: it does not."""
    sent = time.monotonic()
    world.operator.send("incoming/drive-values", numbered(number), qos=0)

    def received() -> bool:
        return any(wheels != STOP and number_of(*wheels) == number for _, wheels in world.rig.mcu.drives(sent))

    return time.monotonic() - sent if until(received, 2 * _OBEYED_S) else float("inf")


def _growth(world: World, before: dict[str, float]) -> list[tuple[str, float]]:
    return [(name, rss_mb(pid) - before.get(name, 0.0)) for name, pid in world.robot.items() if name in before]


def rss_mb(pid: int) -> float:
    """0 for a process that has ended."""
    with suppress(OSError):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:")), 0.0)
    return 0.0


def flooded(world: World, name: str, first: int) -> dict[str, Figures]:
    """A flood of a running robot, then of one that starts; one that starts after what was retained has been planted."""
    before = {program: rss_mb(pid) for program, pid in world.robot.items()}
    found = {}
    with flooding(name, world.remote.port, _SECONDS, "--keep"):
        found["while it runs"] = observe(world, before, first)
    world.rig.stop()
    with ExitStack() as stack:
        if not FLOODS[name].retain:
            stack.enter_context(flooding(name, world.remote.port, _SECONDS + _START_S))
        started = time.monotonic()
        world.start(ready=False)
        until(lambda: [one for one in world.operator.on("outgoing/online", started) if b"false" not in one.payload], 30)
        time.sleep(1.0)
        found["after a restart"] = observe(world, before, first + _COMMANDS)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.soak.floods", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt"), required=True)
    parser.add_argument("--only", choices=NAMES)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that everything that was started ends
    terminal, wrong = Console(), 0
    table = Table(
        "flood", "", "heartbeats", "obeyed", "slowest, s", "MB more", "log lines/s", "", title=options.transport
    )
    for index, name in enumerate([options.only] if options.only else NAMES):
        world = World(options.transport, direct=True)
        try:
            world.start()
            time.sleep(2.0)
            for when, one in flooded(world, name, 1 + 2 * _COMMANDS * index).items():
                wrong += not one.good
                cells = (f"{one.heartbeats:.0%}", f"{one.obeyed} of {_COMMANDS}", f"{one.slowest_s:.2f}")
                grown = f"{one.mb:.1f} ({one.program})"
                table.add_row(name, when, *cells, grown, f"{one.lines:.1f}", "" if one.good else "WRONG")
                terminal.print(f"{name}, {when}: {one}", highlight=False)
        finally:
            world.close()
    terminal.print(table)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
