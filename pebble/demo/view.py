"""What the demo shows: a live table in a terminal, plain lines once a second elsewhere, and a table of results."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Self, TypeVar

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pebble.demo.discovery import Sighting
from pebble.demo.judge import Verdict
from pebble.demo.media import AUDIO, VIDEO, MediaShow
from pebble.demo.media_judge import MediaVerdict
from pebble.demo.operator import Operator
from pebble.demo.robot import SimulatedRobot

_LINE_PERIOD_S = 1.0
_RATE_WINDOW = 20  # looks at a counter
_COLUMN_WIDTH = 26  # characters, of the longest usual cell: a table that does not twitch
_COLUMN_EDGE = 3  # a line, and a space on each side
_LABEL_WIDTH = 20  # the first column, with its edges

T = TypeVar("T")


class Rate:
    """Messages per second over the last looks."""

    def __init__(self) -> None:
        self._looks: deque[tuple[float, int]] = deque(maxlen=_RATE_WINDOW)

    def of(self, count: int, now: float) -> float:
        self._looks.append((now, count))
        (then, before), (_, after) = self._looks[0], self._looks[-1]
        return (after - before) / (now - then) if now > then else 0.0


class View:
    """Shows the robots while they run. ``update`` may be called as often as one likes.

    ``ending`` is set when the terminal was closed: its signal reaches make, which only waits for us.
    """

    def __init__(
        self,
        console: Console,
        operator: Operator,
        show: MediaShow,
        robots: Sequence[SimulatedRobot],
        ending: threading.Event,
    ) -> None:
        self._console, self._operator, self._show = console, operator, show
        self._robots, self._ending = robots, ending
        self._began = time.monotonic()
        self._rates: dict[str, Rate] = {robot.name: Rate() for robot in robots}
        self._said_at = -math.inf
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._notice_closed_terminal()
        if self._live is not None:
            self._live.stop()

    def update(self) -> None:
        self._notice_closed_terminal()
        now = time.monotonic()
        rows = [self._row(robot, now) for robot in self._robots]
        doing = f"{now - self._began:5.1f} s  operator: {self._operator.doing}"
        if self._live is not None:
            tables = [_table(some) for some in _side_by_side(rows, self._console)]
            self._live.update(Group(*tables, Text.assemble(doing, ("   Ctrl-C ends it", "dim"))), refresh=True)
        elif now - self._said_at >= _LINE_PERIOD_S:
            self._said_at = now
            for line in (doing, *("  ".join(["       ", *row.values()]) for row in rows)):
                self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _notice_closed_terminal(self) -> None:
        if self._live is not None and not self._console.is_terminal:
            self._console.quiet = True  # writing to it would be an error from now on
            self._ending.set()

    def _row(self, robot: SimulatedRobot, now: float) -> dict[str, str]:
        sighting = self._sighting(robot.name)
        row = {"robot": f"{robot.name} ({robot.runs_on})"}
        if sighting is None:
            return row | {"transport": "not seen yet"}
        row |= {"transport": sighting.transport, "heartbeat": _heartbeat(sighting, now)}
        row["last command"] = self._command(sighting, now)
        row |= _truth(robot)
        row["battery"] = _battery(sighting)
        if robot.has_imu:
            row["attitude"] = _attitude(sighting)
        if robot.has_media:
            watched = self._show.watched.get(robot.name)
            row["video"] = "" if watched is None else watched.summary("video", now)
            row["audio"] = "" if watched is None else watched.summary("audio", now)
        row["messages"] = f"{self._rates[robot.name].of(sighting.messages, now):3.0f}/s"
        return row

    def _sighting(self, name: str) -> Sighting | None:
        return next((seen for seen in self._operator.discovery.everybody() if seen.name == name), None)

    def _command(self, sighting: Sighting, now: float) -> str:
        if sighting.base not in self._operator.commands:
            return "none yet"
        drive, sent_at = self._operator.commands[sighting.base]
        return f"x {drive.x:+.2f} z {drive.z:+.2f}, {now - sent_at:3.1f} s ago"


def show_results(console: Console, robots: Sequence[str], verdicts: Sequence[Verdict], problems: Sequence[str]) -> None:
    """One row per step, one column per robot, of several rounds the worst; then every problem in words."""
    steps = list(dict.fromkeys(verdict.step for verdict in verdicts))
    for some in _side_by_side(robots, console) if verdicts else ():
        table = Table(title="Seen by the MCUs: the way, and the time until the stop", title_justify="left")
        table.add_column("step")
        for name in some:
            table.add_column(name)
        for step in steps:
            table.add_row(step, *(_cell(step, name, verdicts) for name in some))
        console.print(table)
    for problem in problems:
        console.print(problem, style="red", highlight=False, markup=False, soft_wrap=True)
    if verdicts and not problems:
        console.print("Every robot moved and stopped as commanded.", style="green")


def show_media_results(console: Console, robots: Sequence[str], verdicts: Sequence[MediaVerdict]) -> None:
    """One row per encoding, one column per robot, of several looks the worst."""
    table = Table(title="Seen and heard by the operator", title_justify="left")
    table.add_column("encoding")
    for name in robots:
        table.add_column(name)
    for encoding in (*VIDEO, *AUDIO):
        cells = [[one for one in verdicts if one.robot == name and one.encoding == encoding] for name in robots]
        if any(cells):
            table.add_row(encoding, *(_media_cell(cell) for cell in cells))
    if verdicts:
        console.print(table)


def _media_cell(verdicts: Sequence[MediaVerdict]) -> str:
    if not verdicts:
        return "not done"
    worst = max(verdicts, key=lambda verdict: len(verdict.wrong))
    return f"{'FAILED' if worst.wrong else 'ok'}  {worst.measured}"


def _cell(step: str, name: str, verdicts: Sequence[Verdict]) -> str:
    mine = [verdict for verdict in verdicts if verdict.step == step and verdict.robot == name]
    if not mine:
        return "not done"
    worst = max(mine, key=lambda verdict: (len(verdict.wrong), verdict.stop_s))
    way = f"{worst.ahead_mm:+.0f} mm" if worst.done.step.drive.z else f"{math.degrees(-worst.turned_rad):+.0f}° right"
    return f"{'FAILED' if worst.wrong else 'ok'}  {way}, {worst.stop_s * 1000:.0f} ms"


def _side_by_side(columns: Sequence[T], console: Console) -> Iterator[Sequence[T]]:
    """As many columns at a time as the terminal is wide for; two fit into 80 characters."""
    fitting = max(1, (console.width - _LABEL_WIDTH) // (_COLUMN_WIDTH + _COLUMN_EDGE))
    for first in range(0, len(columns), fitting):
        yield columns[first : first + fitting]


def _table(columns: Sequence[dict[str, str]]) -> Table:
    """One column per robot, without lines: two such tables fit into a terminal of 24 rows."""
    table = Table(show_header=False, box=None, padding=(0, 1))
    table.add_column(style="dim")
    for _ in columns:
        table.add_column(min_width=_COLUMN_WIDTH)
    for label in max(columns, key=len):
        table.add_row(label, *(column.get(label, "") for column in columns), style="bold" if label == "robot" else "")
    table.add_row()
    return table


def _heartbeat(sighting: Sighting, now: float) -> str:
    age, latency = sighting.liveness.age_s(now), sighting.liveness.latency_s
    if age is None:
        return "none yet"
    state = {True: "online", False: "OFFLINE", None: "new"}[sighting.liveness.online(now)]
    return f"{state}, {age:.2f} s ago" + ("" if latency is None else f" ({latency * 1000:.0f} ms)")


def _truth(robot: SimulatedRobot) -> dict[str, str]:
    if not robot.looks:
        return {"wheels": "", "pose": ""}
    board = robot.looks[-1].board
    wheels = f"{board.left_mm_s:+4.0f} {board.right_mm_s:+4.0f} mm/s"
    degrees = math.degrees(board.pose.heading_rad)
    return {"wheels": wheels, "pose": f"{board.pose.x_mm:+5.0f} {board.pose.y_mm:+5.0f} mm {degrees:+4.0f}°"}


def _attitude(sighting: Sighting) -> str:
    attitude = sighting.attitude
    return "unknown" if attitude is None else f"roll {attitude.roll:+.1f}° pitch {attitude.pitch:+.1f}°"


def _battery(sighting: Sighting) -> str:
    if sighting.volts is not None:
        return f"{sighting.volts:.2f} V"
    return {True: "charging", False: "not charging", None: "unknown"}[sighting.charging]
