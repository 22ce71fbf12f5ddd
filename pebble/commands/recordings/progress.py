"""Progress bars of commands that read or write many recordings."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from pebble.recordings.files.reader import RecordingFile

_QUIET_S = 2.0  # before progress is shown


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[float], None]]:
    """Shown on a terminal, and only where it takes longer than two seconds."""
    began, bar = time.monotonic(), None
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    shown = Progress(*columns, console=Console(stderr=True), transient=True)

    def advance(done: float) -> None:
        nonlocal bar
        if bar is None and sys.stderr.isatty() and time.monotonic() - began > _QUIET_S:
            shown.start()
            bar = shown.add_task(what, total=total)
        if bar is not None:
            shown.update(bar, completed=done)

    try:
        yield advance
    finally:
        if bar is not None:
            shown.stop()


@contextmanager
def progress_of_time(paths: list[Path], since_ns: int, until_ns: int) -> Iterator[Callable[[int], None]]:
    first, last = [], [0]
    for path in paths:
        with RecordingFile(path) as file:
            first += [file.first_ns] if file.chunks else []
            last += [file.last_ns] if file.damage.finished else []
    begin = max(since_ns, min(first, default=0))
    end = min(until_ns, max(last))
    with progress("exporting", max(1, end - begin)) as advance:
        yield lambda log_ns: advance(log_ns - begin)
