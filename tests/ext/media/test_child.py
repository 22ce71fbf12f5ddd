"""Programs that are started tied to us."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from pebble.extensions.media.child import Child, tied_to_parent
from tests.support import ROOT, gone, until

PARENT = """
import signal, subprocess, sys, time
from pebble.extensions.media.child import Child, tied_to_parent
child = subprocess.Popen(tied_to_parent([sys.executable, "-c", "import time; time.sleep(100)"], signal.SIGTERM))
print(child.pid, flush=True)
time.sleep(100)
"""


def test_a_child_goes_when_its_parent_is_killed() -> None:
    parent = subprocess.Popen(tied_to_parent([sys.executable, "-c", PARENT]), cwd=ROOT, stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        program, cmdline = sys.executable.encode(), Path(f"/proc/{child}/cmdline")
        assert until(lambda: cmdline.read_bytes().startswith(program)), "until then it is tied to nobody"
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait(10)
    assert until(lambda: gone(child))


def test_what_a_program_leaves_behind_ends_with_it() -> None:
    program = Child(["sh", "-c", "sleep 60 & echo $!"], dict(os.environ), stdout=subprocess.PIPE)
    left = int(program.pipe("stdout").readline())
    assert program.wait() == 0
    assert until(lambda: gone(left))
