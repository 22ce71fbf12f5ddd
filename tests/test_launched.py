"""Programs that are started tied to us."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.launched import tied
from tests.support import ROOT, until

PARENT = """
import signal, subprocess, sys, time
from pebble.launched import tied
child = subprocess.Popen(tied([sys.executable, "-c", "import time; time.sleep(100)"], signal.SIGTERM))
print(child.pid, flush=True)
time.sleep(100)
"""


def test_a_child_goes_when_its_parent_is_killed() -> None:
    parent = subprocess.Popen(tied([sys.executable, "-c", PARENT]), cwd=ROOT, stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        child = Path("/proc", parent.stdout.readline().decode().strip())
        program = sys.executable.encode()
        assert until(lambda: (child / "cmdline").read_bytes().startswith(program)), "until then it is tied to nobody"
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait(10)
    assert until(lambda: _gone(child))


def test_a_program_that_is_not_there_is_named_before_anything_starts() -> None:
    with pytest.raises(FileNotFoundError, match="no-such-program"):
        tied(["no-such-program", "--help"])


def _gone(process: Path) -> bool:
    """Ended; in a container without init nobody may collect it."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True
