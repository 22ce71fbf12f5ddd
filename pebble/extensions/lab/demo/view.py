"""The output of the demo: a line at each step, and the measurements."""

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.table import Table

from pebble.extensions.lab.demo.operator import Operator
from pebble.extensions.lab.demo.outcome import Outcome, Outcomes
from pebble.extensions.lab.rig.robot import SimulatedRobot


class View:
    """A view of the running robots; call ``update`` at any rate.

    It sets ``ending`` when it finds its terminal closed: under make, only make gets the signal SIGHUP for that.
    """

    def __init__(
        self, console: Console, operator: Operator, robots: Sequence[SimulatedRobot], ending: threading.Event
    ) -> None:
        self._console, self._operator, self._robots, self._ending = console, operator, robots, ending
        self._had_terminal = console.is_terminal
        self._began = time.monotonic()
        self._named: set[str] = set()  # robots with a line
        self._step = ""  # the one that was printed last

    def update(self) -> None:
        """Print a line for each newly discovered robot, and for each step and event that begins."""
        with self._until_closed():
            while self._operator.events:
                at, line = self._operator.events.popleft()
                self._print(at, line, "bold yellow")
                self._step = line.removeprefix("operator ")  # the activity says the same: no second line for it below
            now = time.monotonic()
            for robot in self._robots:
                discovered = self._operator.discovery.robots.get(robot.base)
                if discovered is not None and discovered.capabilities and robot.name not in self._named:
                    self._named.add(robot.name)
                    self._print(now, f"{robot.name} is online: {robot.runs_on}, {discovered.transport} inside")
            if self._operator.activity != self._step:
                self._step = self._operator.activity
                self._print(now, f"operator: {self._step}")

    def _print(self, at: float, line: str, style: str = "") -> None:
        self._console.print(
            f"{at - self._began:5.1f} s  {line}", style=style, highlight=False, markup=False, soft_wrap=True
        )

    @contextmanager
    def _until_closed(self) -> Iterator[None]:
        """End the demo if its terminal is closed; then an OSError of the ``with`` block is ignored."""
        self._notice_closed_terminal()
        try:
            yield
        except OSError:
            self._notice_closed_terminal()
            is_closed = self._console.quiet  # _notice_closed_terminal has made it so
            if not is_closed:
                raise

    def _notice_closed_terminal(self) -> None:
        if self._had_terminal and not self._console.is_terminal:
            self._console.quiet = True  # writing to it would be an error from now on
            self._ending.set()


def show_outcomes(console: Console, robots: Sequence[str], outcomes: Outcomes) -> None:
    """Print a table with a row per step and a column per robot, with the worst of several rounds."""
    table = Table("step", *robots, title="Measured by the MCUs: time until the motors were off", title_justify="left")
    for step in outcomes.steps():
        table.add_row(step, *(_cell(outcomes.of(name, step)) for name in robots))
    if table.rows:
        console.print(table)


def _cell(outcome: Outcome | None) -> str:
    if outcome is None:
        return "–"
    off = "never off" if math.isinf(outcome.off_s) else f"{outcome.off_s * 1000:.0f} ms"
    return f"{'FAILED' if outcome.wrong else 'ok'}  {off}"
