"""A pytest plugin that runs tests in several processes: ``--workers 4``. They are forked once all tests are collected.

A worker gets the tests of one module after another, in the order in which they were collected, so each fixture of a
module is made once; tests that share a fixture of their package are one module. With ``--spread``, for few tests that
take long, tests that share no fixture are given one by one. A worker that dies fails its test, and another goes on with
the rest.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import pytest

Indexes = list[int]  # of items, in the order in which they are collected


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--workers", type=int, default=0, help="processes that run tests; 0: the one that collects them")
    parser.addoption("--spread", action="store_true", help="give tests that share no fixture to workers one by one")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--workers"):
        config.pluginmanager.register(Workers(), "workers")


class Worker(NamedTuple):
    pid: int
    left: deque[int]  # what it has been given and not reported; it runs the first of them


class Workers:
    """Forks workers, gives each of them modules, and passes on what they report; in the process that collects."""

    def __init__(self) -> None:
        self._modules: deque[Indexes] = deque()
        self._workers: dict[Connection, Worker] = {}
        self._code = 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if session.testsfailed or session.config.option.collectonly:
            return None  # pytest's own loop runs nothing then, either
        together = shared if session.config.getoption("--spread") else module_of
        groups: dict[str, Indexes] = {}
        for index, item in enumerate(session.items):
            groups.setdefault(together(item), []).append(index)
        self._modules.extend(groups.values())
        try:
            for _ in range(min(session.config.getoption("--workers"), len(self._modules))):
                self._fork(session)
            while self._workers:
                for connection in wait(list(self._workers)):
                    self._receive(session, cast(Connection, connection))
                if reason := session.shouldfail or session.shouldstop:
                    raise session.Interrupted(str(reason))
        finally:
            for connection in list(self._workers):
                self._reap(connection)
        return True

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self._code = int(session.exitstatus)

    @pytest.hookimpl(trylast=True)
    def pytest_unconfigure(self, config: pytest.Config) -> None:
        """Ends without looking for garbage among all tests, and freeing them one by one: three seconds, measured."""
        config.get_terminal_writer().flush()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(self._code)

    def _fork(self, session: pytest.Session) -> None:
        here, there = Pipe()
        if pid := os.fork():
            there.close()
            self._workers[here] = Worker(pid, deque())
            return
        for connection in (here, *self._workers):
            connection.close()
        code = 1
        try:
            work(session, there)
            code = 0
        except (BrokenPipeError, EOFError, KeyboardInterrupt):
            pass  # the run has ended
        except BaseException:  # noqa: BLE001  (nothing of the other process may run in this one)
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
            module = self._modules.popleft() if self._modules else []
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
            self._modules.appendleft(list(worker.left))
        if self._modules:
            self._fork(session)

    def _reap(self, connection: Connection) -> None:
        connection.close()
        os.waitpid(self._workers.pop(connection).pid, 0)


def module_of(item: pytest.Item) -> str:
    """The same for tests of one module, or of one folder if they share a fixture of the whole."""
    return str(item.path.parent if "package" in scopes(item) else item.path)


def shared(item: pytest.Item) -> str:
    """The same for tests that share a fixture which lives longer than one of them."""
    return module_of(item) if scopes(item) - {"function", "session"} else item.nodeid


def scopes(item: pytest.Item) -> set[str]:
    """Those of the fixtures of a test."""
    return {one[-1].scope for one in cast(Any, item)._fixtureinfo.name2fixturedefs.values()}


class Reports:
    """Sends reports to the process that collected the tests."""

    def __init__(self, config: pytest.Config, connection: Connection) -> None:
        self._config, self._connection = config, connection

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "setup" and report.passed:
            return  # of which nothing is shown: two thirds of the reports cost two thirds
        self._connection.send(self._config.hook.pytest_report_to_serializable(config=self._config, report=report))


def work(session: pytest.Session, connection: Connection) -> None:
    """Run what the other process sends, in a worker."""
    config = session.config
    plugins = config.pluginmanager
    writer = SimpleNamespace(_tw=config.get_terminal_writer())  # where config looks for it
    for name in ("workers", "records", "terminalreporter"):
        plugins.unregister(name=name)
    plugins.register(writer, "terminalreporter")
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
