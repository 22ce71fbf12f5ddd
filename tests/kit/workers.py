"""A plugin that runs tests in several processes: ``--workers 8``. They are forked once all tests are collected.

Tests without a mark come first, then those marked ``alone``, with fewer processes, then those marked ``solo``, one
after the other. Tests marked ``computing`` begin when the first of these end, and run when no other needs a processor.

A worker gets the tests of one module after another, in the order in which they were collected, so each fixture of a
module is made once; tests that share a fixture of their package count as one module. Tests marked ``alone``, which take
long, are given one by one unless they share a fixture. If a worker dies, its test fails, and another worker takes the
rest.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, cast

import pytest

Indexes = list[int]  # of items, in the order in which they are collected
ALONE, IDLE = 4, 2  # processes: these tests check deadlines; those of the background


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--workers", type=int, default=0, help="processes that run tests; 0: the one that collects them")


def pytest_configure(config: pytest.Config) -> None:
    """Register the plugin if asked for."""
    if config.getoption("--workers"):
        config.pluginmanager.register(Workers(), "workers")


@dataclass(frozen=True)
class Lane:
    """Tests that a number of processes share."""

    processes: int
    idle: bool = False  # they run when nothing else wants a processor
    modules: deque[Indexes] = field(default_factory=deque)


class Worker(NamedTuple):
    """A process that runs tests of a lane."""

    pid: int
    lane: Lane
    left: deque[int]  # given to it and not reported; it runs the first of them


class Workers:
    """The process that collects: it forks workers, gives each of them modules, and passes on their reports."""

    def __init__(self) -> None:
        self._workers: dict[Connection, Worker] = {}
        self._code = 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if session.testsfailed or session.config.option.collectonly:
            return None  # pytest's own loop runs nothing then, either
        background, *others = lanes(session.items, session.config.getoption("--workers"))
        try:
            for lane in others:
                self._start(session, lane)
                while self._runs(lane):
                    self._wait(session)
                    if not lane.modules:  # its last workers leave processors free
                        self._start(session, background)
            self._start(session, background)
            while self._workers:
                self._wait(session)
        finally:
            for connection in list(self._workers):
                self._reap(connection)
        if left := sum(len(module) for lane in (background, *others) for module in lane.modules):
            raise session.Failed(f"{left} tests did not run: the processes that should have run them died")
        return True

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self._code = int(session.exitstatus)

    @pytest.hookimpl(trylast=True)
    def pytest_unconfigure(self, config: pytest.Config) -> None:
        """End without collecting garbage among all tests and freeing them one by one, which takes three seconds."""
        config.get_terminal_writer().flush()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(self._code)

    def _runs(self, lane: Lane) -> bool:
        """True if a worker of the lane runs."""
        return any(worker.lane is lane for worker in self._workers.values())

    def _start(self, session: pytest.Session, lane: Lane) -> None:
        """Fork the lane's workers, unless some run."""
        if not self._runs(lane):
            for _ in range(min(lane.processes, len(lane.modules))):
                self._fork(session, lane)

    def _wait(self, session: pytest.Session) -> None:
        """Receive the reports of all lanes."""
        for connection in wait(list(self._workers)):
            self._receive(session, cast(Connection, connection))
        if reason := session.shouldfail or session.shouldstop:
            raise session.Interrupted(str(reason))

    def _fork(self, session: pytest.Session, lane: Lane) -> None:
        here, there = Pipe()
        if pid := os.fork():
            there.close()
            self._workers[here] = Worker(pid, lane, deque())
            return
        if lane.idle:
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        for connection in (here, *self._workers):
            connection.close()
        code = 1
        try:
            work(session, there)
            code = 0
        except (BrokenPipeError, EOFError, KeyboardInterrupt):
            pass  # the run has ended
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)

    def _receive(self, session: pytest.Session, connection: Connection) -> None:
        worker, hook = self._workers[connection], session.config.hook
        try:
            received: dict[str, Any] | None = connection.recv()
        except (EOFError, ConnectionResetError):
            self._reap(connection)
            if worker.left:
                self._died(session, worker)
            return
        if received is None:
            module = worker.lane.modules.popleft() if worker.lane.modules else []
            worker.left.extend(module)
            with suppress(BrokenPipeError):
                connection.send(module)
            return
        report = hook.pytest_report_from_serializable(config=session.config, data=received)
        hook.pytest_runtest_logreport(report=report)
        if report.when == "teardown":
            worker.left.popleft()
            hook.pytest_runtest_logfinish(nodeid=report.nodeid, location=report.location)

    def _died(self, session: pytest.Session, worker: Worker) -> None:
        item = session.items[worker.left.popleft()]
        report = pytest.TestReport(
            nodeid=item.nodeid,
            location=item.location,
            keywords={},
            outcome="failed",
            longrepr=f"the process that ran {item.nodeid} died",
            when="call",
        )
        session.config.hook.pytest_runtest_logreport(report=report)
        if worker.left:
            worker.lane.modules.appendleft(list(worker.left))
        if worker.lane.modules:
            self._fork(session, worker.lane)

    def _reap(self, connection: Connection) -> None:
        connection.close()
        os.waitpid(self._workers.pop(connection).pid, 0)


def lanes(items: Sequence[pytest.Item], processes: int) -> list[Lane]:
    """Return the background's lane, then the others in order, and last the lane of single tests."""
    computing, unmarked, alone, solo = Lane(IDLE, idle=True), Lane(processes), Lane(min(ALONE, processes)), Lane(1)
    marked = {"computing": computing, "solo": solo, "alone": alone}
    groups: dict[tuple[int, str], Indexes] = {}
    for index, item in enumerate(items):
        lane = next((lane for name, lane in marked.items() if item.get_closest_marker(name)), unmarked)
        key = id(lane), shared(item) if lane is alone else module_of(item)
        if key not in groups:
            groups[key] = []
            lane.modules.append(groups[key])
        groups[key].append(index)
    longest_first = sorted(alone.modules, key=len, reverse=True)  # so that none is left for the end, by itself
    alone.modules.clear()
    alone.modules.extend(longest_first)
    return [computing, unmarked, alone, solo]


def module_of(item: pytest.Item) -> str:
    """Return a key that is equal for tests of one module, or of one folder if they share a fixture of it."""
    return str(item.path.parent if "package" in scopes(item) else item.path)


def shared(item: pytest.Item) -> str:
    """Return a key that is equal for tests that share a fixture which outlives a single test."""
    return module_of(item) if scopes(item) - {"function", "session"} else item.nodeid


def scopes(item: pytest.Item) -> set[str]:
    """Return the scopes of a test's fixtures."""
    return {one[-1].scope for one in cast(Any, item)._fixtureinfo.name2fixturedefs.values()}


class Terminal:
    """The object that pytest's configuration looks for in place of its reporter."""

    def __init__(self, config: pytest.Config) -> None:
        self._tw = config.get_terminal_writer()


class Reports:
    """A plugin that sends reports to the process that collected the tests."""

    def __init__(self, config: pytest.Config, connection: Connection) -> None:
        self._config, self._connection = config, connection

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "setup" and report.passed:
            return  # of which nothing is shown: two thirds of the reports cost two thirds
        self._connection.send(self._config.hook.pytest_report_to_serializable(config=self._config, report=report))


def work(session: pytest.Session, connection: Connection) -> None:
    """Run, in a worker, the tests that the other process sends."""
    config = session.config
    plugins = config.pluginmanager
    terminal = Terminal(config)
    for name in ("workers", "terminalreporter"):
        plugins.unregister(name=name)
    plugins.register(terminal, "terminalreporter")
    plugins.register(Reports(config, connection))
    if capture := plugins.getplugin("capturemanager"):  # into files of its own
        capture.stop_global_capturing()
        capture.start_global_capturing()
        capture.suspend_global_capture()

    def modules() -> Iterator[list[pytest.Item]]:
        while indexes := ask(connection):
            yield [session.items[index] for index in indexes]

    given = modules()
    items = next(given, [])
    while items:
        for item, following in pairwise(items):
            config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        last, items = items[-1], next(given, [])  # what the next module needs as well is not ended
        config.hook.pytest_runtest_protocol(item=last, nextitem=items[0] if items else None)


def ask(connection: Connection) -> Indexes:
    connection.send(None)
    indexes: Indexes = connection.recv()
    return indexes
