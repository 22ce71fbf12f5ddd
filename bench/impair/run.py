"""Runs the trials one after another: impairs the network, lets the operators run, and restores the network."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from pebble.bench.engine import check_folder, finish
from pebble.bench.impair.cells import Trial, cells_of, over_time
from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.messages import RecoveryRequest
from pebble.bench.impair.network import Traffic, resolved
from pebble.bench.impair.plan import ImpairPlan, Subject
from pebble.bench.impair.report import QUOTED, assessment, tables
from pebble.bench.impair.robots import CLIP_S, FPS, HEIGHT, WIDTH, ImpairedRobot, TestBed
from pebble.bench.results import Results, Stopwatch, Value
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

_T = TypeVar("_T")

CLEAN = Condition("clean")
_UP_S, _STARTUP_S, _PHASE_S = 80.0, 30.0, 30.0  # limits for an operator's next report; its own limits are shorter
_QUIET_S, _QUIET_QUICK_S = 2.0, 1.0  # between two trials of one robot
_ASIDE_S = 5.0  # of a trial in addition to its phases: starting media, a clip, and recovery
_POLL_S = 0.25
_LINKS = {
    "namespaces": "network namespaces, robot's uplink impaired",
    "proxy": "a userspace proxy, loss modelled; robot's uplink impaired",
}


def run(plan: ImpairPlan, console: Console | None = None) -> int:
    """Measures, prints and writes. Raises PebbleError."""
    console = console or Console()
    plan.check()
    check_folder(plan.output)
    kind, why_proxy = resolved(plan.network)
    plan = replace(plan, network=kind)  # the recorded command line uses the same kind
    if why_proxy is not None:
        console.print(f"A proxy replaces the network namespaces: {why_proxy}", highlight=False, soft_wrap=True)
    began_ns, stopwatch = time.monotonic_ns(), Stopwatch("impair", plan.command(), {})
    subjects = [subject for group in plan.groups() for subject in group]
    with interrupted_by_signals(), _progress(console) as progress, TestBed(subjects, plan.network) as test_bed:
        session = _Session(plan, test_bed, progress, began_ns)
        problem = session.run()
    cells = [*cells_of(session.trials, FPS), *over_time(session.trials, began_ns)]
    lines = assessment(cells)
    if problem is not None:
        lines.insert(0, f"The trials ended early: {str(problem).splitlines()[0]}")
    results = stopwatch.results(cells, lines, quick=plan.quick)
    results.options = _options(plan, why_proxy, session.marks)
    show(results, console)
    finish(results, plan.output, console)
    if problem is not None:
        raise PebbleError(f"the trials ended early: {problem}")
    return 0


def show(results: Results, console: Console) -> None:
    """Prints the tables, and the references to compare with."""
    for table in tables(results, console.width):
        console.print(table)
    for line in QUOTED:
        console.print(line, highlight=False, soft_wrap=True, style="dim")


class _Session:
    """Runs the trials with robots that have been started, and collects the results."""

    def __init__(self, plan: ImpairPlan, test_bed: TestBed, progress: Progress, began_ns: int) -> None:
        self.trials: list[Trial] = []
        self.marks: list[str] = []
        self._plan, self._test_bed, self._progress, self._began_ns = plan, test_bed, progress, began_ns
        self._pool = ThreadPoolExecutor(len(test_bed.robots), thread_name_prefix="subject")
        self._done_s = 0.0
        self._task = progress.add_task("starting the robots", total=None)

    def run(self) -> PebbleError | None:
        """Raises PebbleError if no trial succeeded; returns it if it ended the trials early."""
        plan = self._plan
        groups = [[robot for robot in self._test_bed.robots if robot.subject in group] for group in plan.groups()]
        conditions = plan.conditions()
        each_s = _ASIDE_S + _length_s(plan, plan.groups()[0][0])
        self._progress.update(self._task, total=10.0 + each_s * len(groups) * len(conditions))
        try:
            self._all(self._test_bed.robots, lambda robot: robot.next_report(_UP_S))
            self._step(10.0)
            for number, condition in enumerate(conditions):  # the order is reversed after each condition
                turn = slice(None, None, -1 if number % 2 else 1)
                self._condition(condition, [group[turn] for group in groups[turn]], each_s)
        except PebbleError as error:
            if not self.trials:
                raise
            return error
        finally:
            self._test_bed.end_trials()  # unblocks threads that wait for an operator
            self._pool.shutdown()
        return None

    def _condition(self, condition: Condition, groups: Sequence[Sequence[ImpairedRobot]], each_s: float) -> None:
        for group in groups:
            names = ", ".join(robot.subject.name for robot in group)
            self._progress.update(self._task, description=f"{condition.name}: {names}")
            self._all(group, self._recover)
            if group is groups[0]:
                self.marks.append(f"{condition.name}@{(time.monotonic_ns() - self._began_ns) / 1e9:.1f}")
            self._all(group, lambda robot: robot.network.apply(condition))
            self.trials += self._all(group, lambda robot: self._run_trial(robot, condition.name), each_s)
            self._all(group, lambda robot: robot.network.apply(CLEAN))
            self._step(each_s)

    def _recover(self, robot: ImpairedRobot) -> None:
        robot.send(RecoveryRequest(quiet_s=_QUIET_QUICK_S if self._plan.quick else _QUIET_S))
        robot.next_report(_STARTUP_S)

    def _run_trial(self, robot: ImpairedRobot, name: str) -> Trial:
        began_ns = time.monotonic_ns()
        request = self._plan.request(robot.subject)
        robot.send(request)
        traffic: dict[str, tuple[Traffic, Traffic]] = {}
        phase, before = "", Traffic()
        while True:
            report = robot.next_report(_PHASE_S + request.window_s)
            if report.record is not None:
                return Trial(
                    robot.subject.name, name, report.record, robot.entries(began_ns), traffic, robot.playbacks()
                )
            if report.phase:
                phase, before = report.phase, robot.network.traffic()
            else:
                traffic[phase] = before, robot.network.traffic()

    def _all(
        self, robots: Sequence[ImpairedRobot], act: Callable[[ImpairedRobot], _T], expected_s: float = 0.0
    ) -> list[_T]:
        """Runs ``act`` for all robots at the same time; the first error ends it."""
        began = time.monotonic()
        futures: list[Future[_T]] = [self._pool.submit(act, robot) for robot in robots]
        pending = set(futures)
        while pending:
            done, pending = wait(pending, _POLL_S, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
            part = min(time.monotonic() - began, expected_s)
            self._progress.update(self._task, completed=self._done_s + part)
        return [future.result() for future in futures]

    def _step(self, seconds: float) -> None:
        self._done_s += seconds
        self._progress.update(self._task, completed=self._done_s)


def _length_s(plan: ImpairPlan, subject: Subject) -> float:
    request = plan.request(subject)
    return request.alone_s + 2 * request.window_s + request.grace_s + 2 * request.off_s


def _options(plan: ImpairPlan, why_proxy: str | None, marks: Sequence[str]) -> dict[str, Value | list[Value]]:
    words = _LINKS[plan.network]
    words = words.replace("robot's uplink", "both directions") if plan.both_ways else words
    request = plan.request(plan.groups()[0][0])
    return {
        "link": plan.network,
        "link_words": words,
        "why_proxy": why_proxy,  # None: no proxy, or a requested one
        "both_ways": plan.both_ways,
        "window_s": plan.window,
        "alone_s": request.alone_s,
        "grace_s": request.grace_s,
        "picture": f"{WIDTH}x{HEIGHT} at {FPS} a second, synthetic, jpeg_quality 10, keyframe_interval 5",
        "sound": "16 kHz mono, chunks of 20 ms, synthetic speech",
        "drive_hz": 10,
        "off_s": request.off_s,
        "soundboard": f"a wav file of {CLIP_S:g} s, played by a simulated loudspeaker",
        "marks": ";".join(marks),
    }


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console, transient=True
    )
