"""The other end of a worker (pebble.extensions.lab.rig.processes): lines from standard input, answers in JSON lines.

It needs only the standard library: the system's Python, which has GStreamer, imports it as a plain file.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable
from typing import Any

Handle = Callable[[str], bytes | dict[str, Any] | None]


def answer(what: bytes | dict[str, Any]) -> None:
    """Write one answer; bytes are JSON already."""
    sys.stdout.buffer.write((what if isinstance(what, bytes) else json.dumps(what).encode()) + b"\n")
    sys.stdout.buffer.flush()


def serve(handle: Handle) -> None:
    """Pass each line to ``handle`` and write its answer, if any, until standard input closes."""
    for line in sys.stdin:
        if (reply := handle(line.strip())) is not None:
            answer(reply)


def serve_on_thread(handle: Handle, end: Callable[[], object] = lambda: None) -> threading.Event:
    """Serve lines as :func:`serve`, on another thread.

    The returned event is set, and ``end`` is called, when standard input has closed.
    """
    ended = threading.Event()

    def run() -> None:
        serve(handle)
        ended.set()
        end()

    threading.Thread(target=run, daemon=True).start()
    return ended
