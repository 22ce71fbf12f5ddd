"""A pytest plugin that writes the names of failed tests to a file, one per line."""

from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--failed-list", help="file for the names of failed tests")


class FailedTests:
    """Collects in the process that collects the workers' reports, too."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: dict[str, None] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._names[report.nodeid] = None

    def pytest_sessionfinish(self) -> None:
        self._path.write_text("".join(f"{name}\n" for name in self._names))


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--failed-list")
    if path and not hasattr(config, "workerinput"):
        config.pluginmanager.register(FailedTests(Path(path)))
