"""Progress bars of commands that read or write many recordings."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from pebble.extensions.recordings.files.reader import RecordingFile

_QUIET_S = 2.0  # before progress is shown


@contextmanager
def progress_of_steps() -> Iterator[Callable[[str, float], None]]:
    """Yield a function that reports a step of the work, and how much of it is done (0 to 1).

    It shows a bar on a terminal if the work takes over two seconds.
    """
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    bar, quiet_until = Progress(*columns, console=Console(stderr=True), transient=True), time.monotonic() + _QUIET_S
    task = bar.add_task("", total=1.0)

    def show(what: str, share: float) -> None:
        bar.update(task, description=what, completed=share)
        if sys.stderr.isatty() and time.monotonic() > quiet_until:
            bar.start()

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[float], None]]:
    """Yield a function that reports how much of ``total`` is done, for work of a single step."""
    with progress_of_steps() as show:
        yield lambda done: show(what, done / max(1, total))


@contextmanager
def progress_of_time(paths: list[Path], since_ns: int, until_ns: int) -> Iterator[Callable[[int], None]]:
    """Yield a function that moves a progress bar; call it with the time of each message when that is exported."""
    first_ns, last_ns = [], [0]
    for path in paths:
        with RecordingFile(path) as file:
            if file.chunks:
                first_ns.append(file.first_ns)
            if file.damage.finished:  # the end of another file may still move
                last_ns.append(file.last_ns)
    begin = max(since_ns, min(first_ns, default=0))
    end = min(until_ns, max(last_ns))
    with progress("exporting", end - begin) as advance:
        yield lambda log_ns: advance(log_ns - begin)
