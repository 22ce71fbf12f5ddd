"""Runs the comparisons of a report, each as its own command line, and writes down what they found."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pebble.bench.output import check_folder
from pebble.bench.report_plan import COMPARISONS, Comparison
from pebble.bench.report_text import Section, text
from pebble.bench.results import Results, load
from pebble.errors import PebbleError
from pebble.launched import tied
from pebble.signals import interrupted_by_signals

NAME = "README.md"
_WIDTH = 110  # characters of the comparisons' tables
_LOOK_S = 0.2
_PATIENCE = 4  # times the expected time, then a comparison hangs
_PATIENCE_S = 60.0  # and this
_END_S = 20.0  # for a comparison to end its processes when it is told to
_HUNG = -1


def run(comparisons: Sequence[Comparison], folder: Path, *, quick: bool, console: Console | None = None) -> int:
    """Measure and write; 0 if every comparison ended well. One that fails does not keep the others from running.

    Raises PebbleError where nothing can be written.
    """
    console = console or Console()
    _need_matplotlib()  # before an hour of measuring, not after it
    check_folder(folder)
    expected = sum(one.expected_s(quick) for one in comparisons)
    about = f"{expected / 60:.0f} min" if expected > 120 else f"{expected} s"
    console.print(f"{len(comparisons)} comparisons: about {about}", highlight=False)
    with interrupted_by_signals():
        failed = _measure(comparisons, folder, quick, console)
    write(folder, anew=False)
    console.print(f"Written: {folder / NAME}", highlight=False, soft_wrap=True)
    for name, why in failed.items():
        console.print(f"{name} {why}: see {folder / name}.txt", style="red", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def write(folder: Path, *, anew: bool = True) -> Path:
    """README.md from the results and the output that are in ``folder``, and the pictures: all ``anew``, or the missing.

    Raises PebbleError.
    """
    _need_matplotlib()
    sections = [section for one in COMPARISONS if (section := _section(one, folder, anew)) is not None]
    if not sections:
        raise PebbleError(f"{folder} holds no results of pebble bench: run pebble bench report {folder}")
    path = folder / NAME
    try:
        path.write_text(text(sections))
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    return path


def _need_matplotlib() -> None:
    if find_spec("matplotlib") is None:
        raise PebbleError("a report has pictures, and matplotlib is not installed: pip install 'pebble-robot[bench]'")


def _section(comparison: Comparison, folder: Path, anew: bool) -> Section | None:
    """None for what was never run."""
    said, measured = folder / f"{comparison.name}.txt", folder / f"{comparison.name}.json"
    if not said.exists() and not measured.exists():
        return None
    words = said.read_text(errors="replace") if said.exists() else ""
    if not measured.exists():
        return Section(comparison=comparison, results=None, said=words)
    try:
        results = load(measured)
    except PebbleError as error:  # of another version: no reason to lose what the others took an hour for
        return Section(comparison=comparison, results=None, said=str(error))
    return Section(comparison=comparison, results=results, said=words, pictures=_pictures(results, folder, anew))


def _pictures(results: Results, folder: Path, anew: bool) -> list[tuple[str, str]]:
    """Files and captions. The comparison itself has drawn them already, when it was run just now."""
    from pebble.bench.plots import draw, pictures

    named = [(f"{picture.name}.png", picture.caption) for picture in pictures(results)]
    if anew or not all((folder / name).exists() for name, _ in named):
        draw(results, folder)
    return named


class _Bar:
    """How far all of it is, by the expected times."""

    def __init__(self, progress: Progress, comparisons: Sequence[Comparison], quick: bool) -> None:
        self._progress, self._quick, self._count = progress, quick, len(comparisons)
        self._task = progress.add_task("", total=sum(one.expected_s(quick) for one in comparisons), left="")
        self._number, self._done = 0, 0
        self._now: Comparison | None = None

    def next(self, comparison: Comparison) -> None:
        if self._now is not None:
            self._done += self._now.expected_s(self._quick)
        self._now = comparison
        self._number += 1

    def tick(self, since_s: float) -> None:
        if self._now is None:
            return
        expected = self._now.expected_s(self._quick)
        self._progress.update(
            self._task,
            description=f"{self._number} of {self._count}: {self._now.name}",
            completed=self._done + min(since_s, expected),
            left=f"{since_s:.0f} s of about {expected}",
        )


def _measure(comparisons: Sequence[Comparison], folder: Path, quick: bool, console: Console) -> dict[str, str]:
    """What failed, and how."""
    failed = {}
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = _Bar(progress, comparisons, quick)
        for one in comparisons:
            _forget(one, folder)
            bar.next(one)
            began = time.monotonic()
            code = _run(one, folder, quick, bar.tick)
            how = _how(code, folder / f"{one.name}.json")
            took = f"{one.name}: {time.monotonic() - began:.0f} s"
            console.print(", ".join(filter(None, (took, how))), highlight=False, soft_wrap=True)
            if how:
                failed[one.name] = how
    return failed


def _how(code: int, measured: Path) -> str:
    """What went wrong; empty when nothing did."""
    if code == _HUNG:
        return "hung and was ended"
    if code:
        return f"ended with code {code}"
    return "" if measured.exists() else "left no results"


def _run(comparison: Comparison, folder: Path, quick: bool, tick: Callable[[float], None]) -> int:
    """The exit code of its command line. Whatever ends us ends it."""
    words = [*comparison.arguments(quick), "--output", str(folder)]
    began, longest = time.monotonic(), _PATIENCE * comparison.expected_s(quick) + _PATIENCE_S
    path = folder / f"{comparison.name}.txt"
    with path.open("wb") as said:
        process = subprocess.Popen(
            tied([sys.executable, "-m", "pebble.cli", *words], signal.SIGTERM),
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # a Ctrl-C in the terminal is ours to act on, in order
            env=_plain(os.environ),
        )
        try:
            while process.poll() is None and time.monotonic() - began < longest:
                tick(time.monotonic() - began)
                time.sleep(_LOOK_S)
            hung = process.poll() is None
        finally:
            _end(process)
    return _HUNG if hung else process.returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    """Let it end its own processes, in order; the hard way if it does not."""
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _plain(environment: Mapping[str, str]) -> dict[str, str]:
    """For tables as plain text, equally wide everywhere."""
    kept = {name: value for name, value in environment.items() if name not in ("FORCE_COLOR", "TTY_COMPATIBLE")}
    return {**kept, "COLUMNS": str(_WIDTH), "NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}


def _forget(comparison: Comparison, folder: Path) -> None:
    """What an earlier run left: a failure must not hide behind it."""
    from pebble.bench.plots import pictures

    measured = folder / f"{comparison.name}.json"
    try:
        old = [f"{picture.name}.png" for picture in pictures(load(measured))] if measured.exists() else []
    except PebbleError:  # of another format: its pictures, if any, will be written over
        old = []
    for name in (*old, measured.name, f"{comparison.name}.txt"):
        (folder / name).unlink(missing_ok=True)
