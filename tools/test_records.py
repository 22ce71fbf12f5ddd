"""A pytest plugin that writes what became of the tests to files: names of failed ones, and what each test took."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

COST = "cost"
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--failed-list", help="file for the names of failed tests, one per line")
    parser.addoption("--times", help="file to append to, per test: seconds, seconds of processor time, name")


def _processor_s() -> float:
    """Processor time of this process and of all that it has started, running ones too, seconds."""
    return sum(os.times()[:4]) + sum(map(_used_s, _descendants(os.getpid())))


def _descendants(pid: int) -> Iterator[int]:
    """Running ones; of Linux only."""
    with suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):
                for child in map(int, (thread / "children").read_text().split()):
                    yield child
                    yield from _descendants(child)


def _used_s(pid: int) -> float:
    """What a process and the children that it has waited for have used."""
    with suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) * _TICK_S
    return 0.0


class Costs:
    """Measures each test from its set-up to its clean-up, in the process that runs it.

    What a shared fixture takes counts for the test that starts or ends it; what runs on between two, for the second.
    """

    def __init__(self) -> None:
        self._began = self._used = 0.0
        self._pid = 0  # of the worker that has measured last

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        self._began = time.monotonic()
        if self._pid != os.getpid():
            self._pid, self._used = os.getpid(), _processor_s()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Iterator[None]:
        try:
            yield
        finally:
            used, self._used = self._used, _processor_s()
            took = time.monotonic() - self._began
            item.user_properties.append((COST, f"{took:.2f}\t{self._used - used:.2f}"))


class Records:
    """Collects the reports of all processes, in the one that started them."""

    def __init__(self, failed: str | None, times: str | None) -> None:
        self._failed_path, self._times_path = failed, times
        self._failed: dict[str, None] = {}
        self._times: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed[report.nodeid] = None
        if report.when == "teardown" and (cost := dict(report.user_properties).get(COST)):
            self._times.append(f"{cost}\t{report.nodeid}\n")

    def pytest_sessionfinish(self) -> None:
        if self._failed_path:
            Path(self._failed_path).write_text("".join(f"{name}\n" for name in self._failed))
        if self._times_path:
            with Path(self._times_path).open("a") as file:
                file.writelines(self._times)


def pytest_configure(config: pytest.Config) -> None:
    failed, times = config.getoption("--failed-list"), config.getoption("--times")
    if times:
        config.pluginmanager.register(Costs())
    config.pluginmanager.register(Records(failed, times), "records")  # workers have none
