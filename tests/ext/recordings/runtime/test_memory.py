"""The memory of a process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support import ROOT

# A last block that lives keeps all pages below it, which hold nothing, at the process.
_TEST = """
import os
from tests.own_memory import own_mb
from pebble.extensions.recordings.recorder.background import return_free_pages

blocks = [bytes(2000) for _ in range(20_000)]
last = blocks.pop()
del blocks
before = own_mb(os.getpid())
return_free_pages()
print(before - own_mb(os.getpid()))
"""


@pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="needs glibc")
def test_free_pages_are_returned() -> None:
    command = [sys.executable, "-c", _TEST]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=30)
    assert float(done.stdout) > 30
