"""A serial port with a board behind it: a pty."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def serial_port() -> Iterator[tuple[int, str]]:
    """The board's end, and the path of the host's."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        yield ours, os.ttyname(theirs)
    finally:
        os.close(theirs)
        os.close(ours)
