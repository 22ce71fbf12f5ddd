"""What is left of a manager that was killed ends before the next one starts anything."""

from __future__ import annotations

import errno
import signal
import sys
import threading
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.services.autonomy_manager import guard
from pebble.services.autonomy_manager.child import Launch, Processes
from pebble.services.autonomy_manager.guard import Guard
from tests.support import ROOT, Child, gone, refused, until

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
