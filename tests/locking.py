"""The mark of tests that lock memory for frames: skipped where this user may not, as ``pebble doctor`` judges."""

from __future__ import annotations

import os
import resource

import pytest

from pebble.check_result import State
from pebble.extensions.checks.machine import memory_lock

_found = memory_lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], root=os.geteuid() == 0)
needs_shared_memory = pytest.mark.skipif(_found.state is not State.OK, reason=f"{_found.text}: {_found.fix}")
