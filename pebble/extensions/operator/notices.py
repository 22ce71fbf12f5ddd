"""Lines about what a command waits for, and has not done; and a thread for lines."""

import logging
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

import typer

from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown
from pebble.errors import PebbleError

log = logging.getLogger(__name__)

PATIENCE_S = 1.0  # for which a command may be silent
_LAST_S = 0.1  # for a line that is being printed: a terminal that stands still holds up nothing else
_MOST = 1000  # prints that wait


def say(text: str) -> None:
    """Print a line to stderr."""
    with suppress(OSError):  # its reader has ended
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


@contextmanager
def or_undone(undone: str) -> Iterator[None]:
    """Raise PebbleError that begins with ``undone`` instead of any error, and instead of an interrupt."""
    try:
        yield
    except (KeyboardInterrupt, typer.Abort):
        raise PebbleError(f"{undone}: interrupted") from None
    except PebbleError as error:
        raise PebbleError(f"{undone}: {error}") from None
    except Exception:
        log.exception("an unexpected error")
        raise PebbleError(f"{undone}: an unexpected error, see above") from None


class PrintingThread:
    """A thread that prints in turn, so that a terminal that stands still holds up nothing else.

    Of more than _MOST prints that wait, the newest are dropped; a line then says how many.
    """

    def __init__(self) -> None:
        self._prints = queue.SimpleQueue[Callable[[], object] | None]()
        self._dropped = 0  # and not said
        self._thread = threading.Thread(target=self._work, name="pebble-print", daemon=True)
        self._thread.start()

    def run(self, prints: Callable[[], object]) -> None:
        """Call ``prints`` after all earlier ones."""
        if self._prints.qsize() < _MOST:
            self._prints.put(prints)
        else:
            self._dropped += 1

    def close(self, wait_s: float | None = None) -> None:
        """End when all is printed; wait for that, if ``wait_s`` is given at most so long."""
        self._prints.put(None)
        self._thread.join(wait_s)

    def _work(self) -> None:
        for prints in iter(self._prints.get, None):
            try:
                prints()
            except Exception:  # such as a character that the terminal does not have
                log.exception("a line cannot be printed")
            if self._dropped and self._prints.qsize() <= 1:  # at most the end of all
                dropped, self._dropped = self._dropped, 0
                say(f"lines that were not printed, as too many waited: {dropped}")


@contextmanager
def printing_thread() -> Iterator[PrintingThread]:
    """Yield a thread that prints, also what this process logs meanwhile; at the end wait a moment for it."""
    printing = PrintingThread()
    pebble, last = logging.getLogger("pebble"), logging.lastResort  # the last: of what has no other handler
    handlers = pebble.handlers
    pebble.handlers = [_LaterHandler(handler, printing) for handler in handlers]
    logging.lastResort = None if last is None else _LaterHandler(last, printing)
    try:
        yield printing
    finally:
        pebble.handlers, logging.lastResort = handlers, last
        printing.close(PATIENCE_S)


class _LaterHandler(logging.Handler):
    """A handler of log records that another one prints, on a thread."""

    def __init__(self, handler: logging.Handler, printing: PrintingThread) -> None:
        super().__init__(handler.level)
        self._handler, self._printing = handler, printing

    def emit(self, record: logging.LogRecord) -> None:
        self._printing.run(partial(self._handler.handle, record))
