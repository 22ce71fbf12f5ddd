"""Whether this user may lock enough memory for frames in shared memory: 8 MB are usual for others than root."""

from __future__ import annotations

import pytest

from pebble.transports.frames.shared_memory import lockable

needs_shared_memory = pytest.mark.skipif(not lockable(64 << 20), reason="may lock too little memory: see ulimit -l")
