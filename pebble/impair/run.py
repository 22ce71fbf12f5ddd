"""The trials, one after the other: the link gets bad, the operators do as always, it gets good again."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from pebble.bench.output import check_folder, finish
from pebble.bench.results import Results, Stopwatch, Value
from pebble.errors import PebbleError
from pebble.impair.cells import Trial, cells_of, over_time
from pebble.impair.conditions import Condition
from pebble.impair.link import Carried, resolved
from pebble.impair.messages import Settle
from pebble.impair.plan import Plan, Subject
from pebble.impair.report import QUOTED, tables, verdict
from pebble.impair.robots import FPS, HEIGHT, WIDTH, Field, Robot
from pebble.signals import interrupted_by_signals

_T = TypeVar("_T")

CLEAN = Condition("clean")
_UP_S, _SETTLE_S, _PHASE_S = 80.0, 30.0, 30.0  # the longest an operator may be silent: its own limits are shorter
_QUIET_S, _QUIET_QUICK_S = 2.0, 1.0  # between two trials of one robot
_ASIDE_S = 4.0  # of a trial, beside its phases: until media flow, and to settle
_LOOK_S = 0.25
_LINKS = {
    "namespaces": "network namespaces, robot's uplink impaired",
    "proxy": "a userspace proxy, loss modelled; robot's uplink impaired",
}


def run(plan: Plan, console: Console | None = None) -> int:
    """Measure, show and write. Raises PebbleError."""
    console = console or Console()
    plan.check()
    check_folder(plan.output)
    kind, why_proxy = resolved(plan.link)
    plan = replace(plan, link=kind)  # the command line that repeats it takes the same
    if why_proxy is not None:
        console.print(f"A proxy stands in for the link: {why_proxy}", highlight=False, soft_wrap=True)
    began_ns, stopwatch = time.monotonic_ns(), Stopwatch("impair", plan.command(), {})
    subjects = [subject for group in plan.groups() for subject in group]
    with interrupted_by_signals(), _progress(console) as progress, Field(subjects, plan.link) as field:
        session = _Session(plan, field, progress, began_ns)
        problem = session.run()
    cells = [*cells_of(session.trials, FPS), *over_time(session.trials, began_ns)]
    said = verdict(cells)
    if problem is not None:
        said.insert(0, f"The trials ended early: {str(problem).splitlines()[0]}")
    results = stopwatch.results(cells, said, quick=plan.quick)
    results.options = _options(plan, why_proxy, session.marks)
    show(results, console)
    finish(results, plan.output, console)
    if problem is not None:
        raise PebbleError(f"the trials ended early: {problem}")
    return 0


def show(results: Results, console: Console) -> None:
    """The tables, and what to hold beside them."""
    for table in tables(results, console.width):
        console.print(table)
    for line in QUOTED:
        console.print(line, highlight=False, soft_wrap=True, style="dim")


class _Session:
    """Robots that are up, and what they went through."""

    def __init__(self, plan: Plan, field: Field, progress: Progress, began_ns: int) -> None:
        self.trials: list[Trial] = []
        self.marks: list[str] = []
        self._plan, self._field, self._progress, self._began_ns = plan, field, progress, began_ns
        self._pool = ThreadPoolExecutor(len(field.robots), thread_name_prefix="subject")
        self._done_s = 0.0

    def run(self) -> PebbleError | None:
        """Raises PebbleError if there is no trial to show; returns it if it ended the trials early."""
        plan = self._plan
        groups = [[robot for robot in self._field.robots if robot.subject in group] for group in plan.groups()]
        conditions = plan.conditions()
        each_s = _ASIDE_S + _length_s(plan, plan.groups()[0][0])
        self._task = self._progress.add_task("starting the robots", total=10.0 + each_s * len(groups) * len(conditions))
        try:
            self._all(self._field.robots, lambda robot: robot.hear(_UP_S))
            self._step(10.0)
            for number, condition in enumerate(conditions):  # whoever comes first, comes last in the next
                turn = slice(None, None, -1 if number % 2 else 1)
                self._condition(condition, [group[turn] for group in groups[turn]], each_s)
        except PebbleError as error:
            if not self.trials:
                raise
            return error
        finally:
            self._field.hurry()  # threads that still wait for an operator hear its end
            self._pool.shutdown()
        return None

    def _condition(self, condition: Condition, groups: Sequence[Sequence[Robot]], each_s: float) -> None:
        for group in groups:
            names = ", ".join(robot.subject.name for robot in group)
            self._progress.update(self._task, description=f"{condition.name}: {names}")
            self._all(group, self._settle)
            if group is groups[0]:
                self.marks.append(f"{condition.name}@{(time.monotonic_ns() - self._began_ns) / 1e9:.1f}")
            self._all(group, lambda robot: robot.link.apply(condition))
            self.trials += self._all(group, lambda robot: self._try(robot, condition.name), each_s)
            self._all(group, lambda robot: robot.link.apply(CLEAN))
            self._step(each_s)

    def _settle(self, robot: Robot) -> None:
        robot.tell(Settle(quiet_s=_QUIET_QUICK_S if self._plan.quick else _QUIET_S))
        robot.hear(_SETTLE_S)

    def _try(self, robot: Robot, name: str) -> Trial:
        began_ns = time.monotonic_ns()
        order = self._plan.order(robot.subject)
        robot.tell(order)
        carried: dict[str, tuple[Carried, Carried]] = {}
        phase, before = "", Carried()
        while True:
            said = robot.hear(_PHASE_S + order.window_s)
            if said.record is not None:
                return Trial(robot.subject.name, name, said.record, robot.entries(began_ns), carried)
            if said.phase:
                phase, before = said.phase, robot.link.carried()
            else:
                carried[phase] = before, robot.link.carried()

    def _all(self, robots: Sequence[Robot], act: Callable[[Robot], _T], expected_s: float = 0.0) -> list[_T]:
        """At the same time; the first that fails ends it."""
        began = time.monotonic()
        futures: list[Future[_T]] = [self._pool.submit(act, robot) for robot in robots]
        pending = set(futures)
        while pending:
            done, pending = wait(pending, _LOOK_S, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
            part = min(time.monotonic() - began, expected_s)
            self._progress.update(self._task, completed=self._done_s + part)
        return [future.result() for future in futures]

    def _step(self, seconds: float) -> None:
        self._done_s += seconds
        self._progress.update(self._task, completed=self._done_s)


def _length_s(plan: Plan, subject: Subject) -> float:
    order = plan.order(subject)
    return order.alone_s + 2 * order.window_s + order.grace_s


def _options(plan: Plan, why_proxy: str | None, marks: Sequence[str]) -> dict[str, Value | list[Value]]:
    words = _LINKS[plan.link]
    words = words.replace("robot's uplink", "both directions") if plan.both_ways else words
    order = plan.order(plan.groups()[0][0])
    return {
        "link": plan.link,
        "link_words": words,
        "why_proxy": why_proxy,  # None: it is none, or was asked for
        "both_ways": plan.both_ways,
        "window_s": plan.window,
        "alone_s": order.alone_s,
        "grace_s": order.grace_s,
        "picture": f"{WIDTH}x{HEIGHT} at {FPS} a second, synthetic, jpeg_quality 10, keyframe_interval 5",
        "sound": "16 kHz mono, chunks of 20 ms, synthetic speech",
        "drive_hz": 10,
        "soundboard": "not offered by these robots: skipped",
        "marks": ";".join(marks),
    }


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console, transient=True
    )
