"""The demo, started as a user starts it, and what it leaves behind."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support import ROOT, WAIT_S, until

START_S = 40.0
MARK = "PEBBLE_TEST_DEMO"


class Demo:
    """A run of the demo. All its processes inherit a variable that marks them."""

    def __init__(self, folder: Path, code: str, terminal: int | None = None) -> None:
        self.temporary = folder
        self.log = folder / "demo.log"
        self._mark = uuid.uuid4().hex
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code],
                cwd=ROOT,
                env={**os.environ, MARK: self._mark, "TMPDIR": str(folder)},
                stdout=output if terminal is None else terminal,
                stderr=output,
            )

    @property
    def output(self) -> str:
        return self.log.read_text()

    def leftovers(self) -> list[str]:
        """Return the command lines of living processes that this demo started."""
        entry = f"{MARK}={self._mark}".encode()
        return [line for pid in _pids() if entry in _read(pid, "environ") and (line := _command(pid))]

    def folders(self) -> list[Path]:
        return list(self.temporary.glob("pebble-demo-*"))

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(WAIT_S)


def _pids() -> list[str]:
    return [path.name for path in Path("/proc").iterdir() if path.name.isdecimal() and int(path.name) != os.getpid()]


def _read(pid: str, name: str) -> bytes:
    try:
        return Path("/proc", pid, name).read_bytes()
    except OSError:  # it has ended meanwhile
        return b""


def _command(pid: str) -> str:
    return _read(pid, "cmdline").replace(b"\0", b" ").decode()


@pytest.fixture
def temporary() -> Iterator[Path]:
    """Yield a short path for the robots' unix sockets, whose paths are limited to 108 bytes."""
    with tempfile.TemporaryDirectory(prefix="pebble-", dir="/tmp") as folder:
        yield Path(folder)
        assert until(lambda: not any(folder in _command(pid) for pid in _pids()))  # of a demo that was killed


@pytest.fixture
def demos(temporary: Path) -> Iterator[list[Demo]]:
    """Yield a list; demos that a test appends to it are ended afterwards."""
    running: list[Demo] = []
    yield running
    for demo in running:
        demo.end()


def start(demos: list[Demo], folder: Path, arguments: str, terminal: int | None = None) -> Demo:
    imports = "import sys; from pebble.extensions.lab.demo.main import run"
    demos.append(Demo(folder, f"{imports}; sys.exit(run({arguments}))", terminal))
    return demos[-1]


def page_of(demo: Demo) -> str:
    """Return the address of the operator page, once it was printed."""
    printed = re.compile(r"in a browser: (http://127.0.0.1:\d+/)\n").findall
    assert until(lambda: printed(demo.output), START_S), demo.output
    return str(printed(demo.output)[0])
