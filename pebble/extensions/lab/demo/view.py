"""Output of the demo: a live table in a terminal, a plain line at each step elsewhere, and what was measured."""

import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pebble.extensions.lab.demo.media import CountedMedia, MediaViewer
from pebble.extensions.lab.demo.operator import Operator
from pebble.extensions.lab.demo.outcome import Outcome, Outcomes
from pebble.extensions.lab.rig.robot import SimulatedRobot
from pebble.extensions.operator.client.robot_view import RobotView

_COLUMN_WIDTH = 26  # characters, of the longest usual cell: keeps the layout stable
_COLUMN_EDGE = 3  # a line, and a space on each side
_LABEL_WIDTH = 20  # the first column, with its edges

Cells = dict[str, str]  # of one robot, by their labels


class View:
    """The robots while they run; call ``update`` at any rate.

    ``ending`` is set when the terminal was closed: under make, SIGHUP reaches only make. ``addresses`` stay above the
    table.
    """

    def __init__(
        self,
        console: Console,
        operator: Operator,
        media: MediaViewer,
        robots: Sequence[SimulatedRobot],
        ending: threading.Event,
        addresses: str,
    ) -> None:
        self._addresses = addresses
        self._console, self._operator, self._media = console, operator, media
        self._robots, self._ending = robots, ending
        self._began = time.monotonic()
        self._known: set[str] = set()  # without a terminal: the robots that were named
        self._step = ""  # that was printed last
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        with self._until_closed():
            if self._live is not None:
                self._live.stop()

    def update(self) -> None:
        with self._until_closed():
            self._print_events()
            if self._live is None:
                self._print_changes(time.monotonic())
            else:
                self._draw(self._live, time.monotonic())

    def _draw(self, live: Live, now: float) -> None:
        activity = f"{now - self._began:5.1f} s  operator: {self._operator.activity}"
        rows = [self._row(robot, now) for robot in self._robots]
        tables = [_table(some) for some in _side_by_side(rows, self._console)]
        last = Text.assemble(activity, ("   Ctrl-C ends it", "dim"), no_wrap=True, overflow="ellipsis")
        addresses = Text(self._addresses, style="bold", no_wrap=True, overflow="ellipsis")
        live.update(Group(addresses, *tables, last), refresh=True)

    def _print_changes(self, now: float) -> None:
        """Print a line for each robot when it is discovered, and for each step when it begins."""
        for robot in self._robots:
            seen = self._operator.discovery.robots.get(robot.base)
            if seen is not None and seen.capabilities and robot.name not in self._known:
                self._known.add(robot.name)
                self._print(now, f"{robot.name} is online: {robot.runs_on}, {seen.transport} inside")
        if self._operator.activity != self._step:
            self._step = self._operator.activity
            self._print(now, f"operator: {self._step}")

    def _print(self, at: float, line: str, style: str = "") -> None:
        self._console.print(
            f"{at - self._began:5.1f} s  {line}", style=style, highlight=False, markup=False, soft_wrap=True
        )

    def _print_events(self) -> None:
        """Print them above the live table, where they stay."""
        while self._operator.events:
            at, line = self._operator.events.popleft()
            self._print(at, line, "bold yellow")
            self._step = line.removeprefix("operator ")  # it is one of them

    @contextmanager
    def _until_closed(self) -> Iterator[None]:
        """A terminal may be closed before, or while, something is written to it: that ends the demo in order."""
        self._notice_closed_terminal()
        try:
            yield
        except OSError:
            self._notice_closed_terminal()
            if not self._console.quiet:
                raise

    def _notice_closed_terminal(self) -> None:
        if self._live is not None and not self._console.is_terminal:
            self._console.quiet = True  # writing to it would be an error from now on
            self._ending.set()

    def _row(self, robot: SimulatedRobot, now: float) -> Cells:
        seen = self._operator.discovery.robots.get(robot.base)
        row = {"robot": f"{robot.name} ({robot.runs_on})"}
        if seen is None:
            return row | {"transport": "not discovered yet"}
        row |= {"transport": seen.transport, "heartbeat": _heartbeat(seen, now)}
        row["last command"] = self._command(seen, now)
        row |= _truth(robot)
        row["battery"] = _battery(seen)
        if robot.has_imu:
            at = seen.attitude
            row["attitude"] = "unknown" if at is None else f"roll {at.roll:+.1f}° pitch {at.pitch:+.1f}°"
        if robot.has_scripts:
            row["script"] = _script(seen)
        if robot.has_media:
            media = self._media.received.get(robot.name)
            row["video"] = "" if media is None else media.summary("video", now)
            row["audio"] = "" if media is None else media.summary("audio", now)
        row["messages"] = f"{self._operator.discovery.traffic[seen.base].rate(now):3.0f}/s"
        return row

    def _command(self, seen: RobotView, now: float) -> str:
        driver = self._operator.drivers.get(seen.base)
        if driver is None or driver.newest is None:
            return "none yet"
        drive, sent_at = driver.newest
        return f"x {drive.x:+.2f} z {drive.z:+.2f}, {now - sent_at:3.1f} s ago"


def show_outcomes(console: Console, robots: Sequence[str], outcomes: Outcomes) -> None:
    """Print a table with a row for each step and a column for each robot, of several rounds the worst."""
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


def show_media(console: Console, received: Mapping[str, CountedMedia]) -> None:
    """Print a line for each robot with the number of its pictures and sounds."""
    for name, media in received.items():
        counts = ", ".join(f"{encoding} {number}" for encoding, number in media.counted.items())
        console.print(f"Pictures and sounds from {name}: {counts or 'none'}", highlight=False, soft_wrap=True)


def _side_by_side(columns: Sequence[Cells], console: Console) -> Iterator[Sequence[Cells]]:
    """Yield as many columns as the terminal is wide for; two fit into 80 characters."""
    fitting = max(1, (console.width - _LABEL_WIDTH) // (_COLUMN_WIDTH + _COLUMN_EDGE))
    for first in range(0, len(columns), fitting):
        yield columns[first : first + fitting]


def _table(columns: Sequence[Cells]) -> Table:
    """Return one column per robot, without lines: two such tables fit into a terminal of 24 rows."""
    table = Table(show_header=False, box=None, padding=(0, 1))
    table.add_column(style="dim")
    for _ in columns:
        table.add_column(min_width=_COLUMN_WIDTH)
    for label in max(columns, key=len):
        table.add_row(label, *(column.get(label, "") for column in columns), style="bold" if label == "robot" else "")
    table.add_row()
    return table


def _heartbeat(seen: RobotView, now: float) -> str:
    age, latency = seen.liveness.age_s(now), seen.liveness.latency_s
    if age is None:
        return "none yet"
    state = {True: "online", False: "OFFLINE", None: "new"}[seen.liveness.online(now)]
    return f"{state}, {age:.2f} s ago" + ("" if latency is None else f" ({latency * 1000:.0f} ms)")


def _truth(robot: SimulatedRobot) -> Cells:
    if not robot.mcu_reports:
        return {"wheels": "", "pose": ""}
    board = robot.mcu_reports[-1].board
    wheels = f"{board.left_mm_s:+4.0f} {board.right_mm_s:+4.0f} mm/s"
    degrees = math.degrees(board.pose.heading_rad)
    return {"wheels": wheels, "pose": f"{board.pose.x_mm:+5.0f} {board.pose.y_mm:+5.0f} mm {degrees:+4.0f}°"}


def _script(seen: RobotView) -> str:
    status = seen.autonomy
    if status is None or not status.running:
        return "none runs"
    return f"{status.file}{', overruled' if status.overridden is True else ''}"


def _battery(seen: RobotView) -> str:
    if seen.volts is not None:
        return f"{seen.volts:.2f} V"
    return {True: "charging", False: "not charging", None: "unknown"}[seen.charging]
