"""A script whose file exists and cannot be executed is refused with the fix."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.services.autonomy_manager import guard
from pebble.services.autonomy_manager.child import Launch, Process, Processes
from pebble.services.autonomy_manager.guard import Guard
from tests.support import ROOT, Child, gone, refused, until


def started(path: Path) -> Process:
    return Process(Launch("turn", (str(path),), path.parent, dict(os.environ), signal.SIGKILL))


def script(folder: Path, text: str, mode: int) -> Path:
    path = folder / "turn.sh"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("first", "mode", "problem"),
    [
        ("#!/bin/sh\n", 0o644, "^{path} is not executable: chmod \\+x {path}$"),
        ("#!/no/such/sh -e\n", 0o755, "there is no '/no/such/sh', which its first line names"),
        ("#!/bin/sh\r\n", 0o755, r"there is no '/bin/sh\\r', which its first line names"),
    ],
)
def test_what_cannot_be_executed_is_named_with_the_reason(first: str, mode: int, problem: str, tmp_path: Path) -> None:
    path = script(tmp_path, first, mode)
    with pytest.raises(PebbleError, match=problem.format(path=path)):
        started(path)


def denied(_pid: int) -> int:
    raise PermissionError(errno.EPERM, "Operation not permitted")


@pytest.mark.parametrize(("first", "may"), [("#!/usr/bin/env -S sh -e\n", True), ("\n", True), ("#!/bin/sh\n", False)])
def test_others_start_and_their_end_is_noticed_also_where_pidfd_open_is_denied(
    first: str, may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not may:
        monkeypatch.setattr(os, "pidfd_open", denied)
    codes: list[int] = []
    process = started(script(tmp_path, f"{first}exit 7\n", 0o755))
    process.watch(codes.append)
    process.wait(10)
    assert codes == [7]


# -- what is left of a manager that was killed ends before the next one starts anything


#: Starts a script that ignores SIGTERM, leaves its number in a file, and waits to be killed.
MANAGER = """
import os, signal, sys, time
from pathlib import Path
from pebble.services.autonomy_manager.child import Launch, Processes
deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); open('deaf', 'w'); time.sleep(600)"
folder = Path(sys.argv[1])
script = Processes(folder / "lock")(
    Launch("deaf", (sys.executable, "-c", deaf), folder, dict(os.environ), signal.SIGTERM), print
)
(folder / "pid.new").write_text(str(script.pid))
(folder / "pid.new").rename(folder / "pid")
time.sleep(600)
"""


def test_no_script_starts_before_those_of_a_killed_manager_have_ended(tmp_path: Path) -> None:
    killed = Child([sys.executable, "-c", MANAGER, str(tmp_path)], cwd=ROOT)
    assert until(lambda: (tmp_path / "pid").exists() and (tmp_path / "deaf").exists())
    earlier = int((tmp_path / "pid").read_text())
    killed.kill()
    killed.wait(5)
    assert not gone(earlier), "it has time to end by itself"

    processes, ended = Processes(tmp_path / "lock"), threading.Event()
    sleeper = Launch("sleeper", ("sleep", "600"), tmp_path, {}, signal.SIGKILL)
    script = processes(sleeper, lambda code: ended.set())
    assert gone(earlier), "it has ended before this one began"
    script.signal(signal.SIGKILL)
    assert ended.wait(5)
    processes.close()


def test_a_lock_that_stays_taken_is_an_error_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_LOCKED_S", 0.1)
    first, second = Guard(tmp_path / "lock"), Guard(tmp_path / "lock")
    first.begin()
    first.begin()
    with pytest.raises(PebbleError, match="lock"):
        second.begin()
    first.close()
    second.begin()
    second.close()


def test_without_locks_scripts_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("fcntl.flock", refused(errno.ENOLCK))
    unlocked = Guard(tmp_path / "lock")
    unlocked.begin()
    unlocked.close()
    assert "lock cannot be locked: No locks available" in caplog.text
