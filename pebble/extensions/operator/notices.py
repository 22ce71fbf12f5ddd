"""Lines about what a command waits for."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown

PATIENCE_S = 1.0  # for which a command may be silent
_LAST_S = 0.1  # for a line that is being printed: a terminal that stands still holds up nothing else


def say(text: str) -> None:
    """Print a line to stderr."""
    with suppress(OSError):  # nobody reads it
        sys.stderr.write(f"pebble: {shown(without_secrets(text))}\n")
        sys.stderr.flush()


@contextmanager
def noticed(line: Callable[[], str], after_s: float = PATIENCE_S) -> Iterator[None]:
    """Print ``line()`` to stderr if the block takes longer than ``after_s``; nothing if it is empty by then."""

    def write() -> None:
        if text := line():
            say(text)

    timer = threading.Timer(after_s, write)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join(_LAST_S)
