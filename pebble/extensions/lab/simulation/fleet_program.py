"""A fleet of simulated robots as a program, ``pebble sim fleet --robots 50 --broker mqtt://HOST``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from pebble.extensions.lab.simulation.fleet import ConnectionReporter, Fleet, members
from pebble.extensions.lab.simulation.networked import StopSignal
from pebble.extensions.lab.simulation.wireless import KINDS, BrokerAddress

_TABLE_PERIOD_S, _LINE_PERIOD_S = 1.0, 10.0  # on a terminal, and in plain lines


def run(broker: BrokerAddress, robots: int, kinds: Sequence[str] | None = None, *, seconds: float | None = None) -> int:
    """Run the fleet until a signal, or for some seconds, and show its status. Raises PebbleError.

    Returns 0 if all robots are online at the end.
    """
    console = Console()
    stop_signal = StopSignal()
    with Fleet(broker) as fleet:
        for kind, identity in members(robots, kinds or KINDS):
            fleet.add(kind, identity)
        console.print(f"{robots} robots, {fleet.robots[0].identity.id} and so on; Ctrl-C ends it", highlight=False)
        until = time.monotonic() + seconds if seconds is not None else float("inf")
        with _shown(fleet, console) as show:
            fleet.run(lambda: not stop_signal.received and time.monotonic() < until, show.poll)
        online = sum(robot.online for robot in fleet.robots)
        console.print(show.line(), highlight=False)
    return 0 if online == robots else 1


@contextmanager
def _shown(fleet: Fleet, console: Console) -> Iterator[_Summary]:
    """Show a live table on a terminal, otherwise a line every ten seconds."""
    if console.is_terminal:
        with Live(console=console, auto_refresh=False) as live:
            yield _Summary(fleet, console, live)
    else:
        yield _Summary(fleet, console, None)


class _Summary:
    def __init__(self, fleet: Fleet, console: Console, live: Live | None) -> None:
        self._fleet, self._console, self._live = fleet, console, live
        self._reporter = ConnectionReporter(
            fleet.robots, lambda line: console.print(line, highlight=False, soft_wrap=True)
        )
        self._due = 0.0
        self._before = time.monotonic(), time.process_time(), 0
        self._rates = 0.0, 0.0  # % of one core, turns a second

    def poll(self) -> None:
        self._reporter.poll()
        now = time.monotonic()
        if now < self._due:
            return
        first, self._due = self._due == 0.0, now + (_LINE_PERIOD_S if self._live is None else _TABLE_PERIOD_S)
        self._measure(now)
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
        elif not first:
            self._console.print(self.line(), highlight=False)

    def line(self) -> str:
        self._measure(time.monotonic())
        online, moving = _count(self._fleet, None)
        cpu, turns = self._rates
        return f"{online} of {len(self._fleet.robots)} online, {moving} moving, {turns:.0f} turns/s, {cpu:.0f} % CPU"

    def _measure(self, now: float) -> None:
        then, used, turns = self._before
        if now - then > 0.5:
            current = time.process_time(), self._fleet.scheduler.count
            self._rates = 100 * (current[0] - used) / (now - then), (current[1] - turns) / (now - then)
            self._before = now, *current

    def _table(self) -> Table:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column("robots")
        for name in ("count", "online", "moving"):
            table.add_column(name, justify="right")
        for kind in dict.fromkeys(robot.kind for robot in self._fleet.robots):
            online, moving = _count(self._fleet, kind)
            count = sum(robot.kind == kind for robot in self._fleet.robots)
            table.add_row(kind, *map(str, (count, online, moving)))
        table.caption = f"{self._rates[1]:.0f} turns/s, {self._rates[0]:.0f} % CPU"
        return table


def _count(fleet: Fleet, kind: str | None) -> tuple[int, int]:
    """Numbers of robots that are online and that move, of one kind or of all."""
    robots = [robot for robot in fleet.robots if kind in (None, robot.kind)]
    return sum(robot.online for robot in robots), sum(robot.moving for robot in robots)
