"""Runs the comparisons of a report, each as its own command line, and writes down what they found."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pebble.bench import report_run
from pebble.bench.output import check_folder
from pebble.bench.report_plan import COMPARISONS, Comparison
from pebble.bench.report_run import HUNG, INTERRUPTED, Ended, Run
from pebble.bench.report_text import HEADING, Section, text
from pebble.bench.results import Results, load
from pebble.errors import PebbleError
from pebble.launched import tied
from pebble.signals import interrupted_by_signals

NAME = "README.md"
_WIDTH = 120  # characters of the comparisons' tables
_LOOK_S = 0.2
_PATIENCE = 4  # times the expected time, then a comparison hangs
_PATIENCE_S = 60.0  # and this
_END_S = 20.0  # for a comparison to end its processes when it is told to


def run(
    comparisons: Sequence[Comparison],
    folder: Path,
    *,
    quick: bool,
    left_out: Sequence[Comparison] = (),
    console: Console | None = None,
) -> int:
    """Measure and write; 0 if every comparison ended well. One that fails does not keep the others from running.

    What is ``left_out`` is said to be, and what an earlier run found of it goes. Raises PebbleError where nothing can
    be written.
    """
    console = console or Console()
    _need_matplotlib()  # before an hour of measuring, not after it
    check_folder(folder)
    _check_ours(folder)
    expected = sum(one.expected_s(quick) for one in comparisons)
    about = f"{expected / 60:.0f} min" if expected > 120 else f"{expected} s"
    console.print(f"{len(comparisons)} comparisons: about {about}", highlight=False)
    known = _begin(comparisons, left_out, folder)
    try:
        with interrupted_by_signals():
            _measure(comparisons, folder, quick, known, console)
    except KeyboardInterrupt:
        with suppress(PebbleError):  # there is nothing to write about yet
            write(folder, anew=False)
        raise
    write(folder, anew=False)
    console.print(f"Written: {folder / NAME}", highlight=False, soft_wrap=True)
    failed = {one.name: wrong for one in comparisons if (wrong := known.ended[one.name].wrong)}
    for name, why in failed.items():
        console.print(f"{name} {why}: see {folder / name}.txt", style="red", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _begin(comparisons: Sequence[Comparison], left_out: Sequence[Comparison], folder: Path) -> Run:
    """What is known of the folder, without what will be measured now or cannot be."""
    known = report_run.load(folder)
    for one in left_out:
        _forget(one, folder)
        known.ended.pop(one.name, None)
    told = {one.name for one in (*comparisons, *left_out)}
    known.left_out = [*(name for name in known.left_out if name not in told), *(one.name for one in left_out)]
    return known


def write(folder: Path, *, anew: bool = True) -> Path:
    """README.md from the results and the output that are in ``folder``, and the pictures: all ``anew``, or the missing.

    Raises PebbleError.
    """
    _need_matplotlib()
    _check_ours(folder)
    known = report_run.load(folder)
    sections = [section for one in COMPARISONS if (section := _section(one, folder, known, anew)) is not None]
    if not sections:
        raise PebbleError(f"{folder} holds no results of pebble bench: run pebble bench report {folder}")
    path = folder / NAME
    try:
        path.write_text(text(sections, known))
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    return path


def _need_matplotlib() -> None:
    if find_spec("matplotlib") is None:
        raise PebbleError("a report has pictures, and matplotlib is not installed: pip install 'pebble-robot[bench]'")


def _check_ours(folder: Path) -> None:
    """Raises PebbleError rather than write over somebody's README.md."""
    path = folder / NAME
    try:
        ours = not path.exists() or path.read_text(errors="replace").startswith(HEADING)
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    if not ours:
        raise PebbleError(f"{path} is no report of pebble bench and would be written over: name another folder")


def _section(comparison: Comparison, folder: Path, known: Run, anew: bool) -> Section | None:
    """None for what was never run."""
    said, measured = folder / f"{comparison.name}.txt", folder / f"{comparison.name}.json"
    if not said.exists() and not measured.exists():
        return None
    words = said.read_text(errors="replace") if said.exists() else ""
    ended = known.ended.get(comparison.name)
    if not measured.exists():
        return Section(comparison=comparison, results=None, said=words, ended=ended)
    try:
        results = load(measured)
    except PebbleError as error:  # of another version: no reason to lose what the others took an hour for
        return Section(comparison=comparison, results=None, said=str(error), ended=ended)
    pictures = _pictures(results, folder, anew)
    return Section(comparison=comparison, results=results, said=words, ended=ended, pictures=pictures)


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


def _measure(comparisons: Sequence[Comparison], folder: Path, quick: bool, known: Run, console: Console) -> None:
    """All of them; how each ended is ``known`` at once, whatever becomes of the next."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = _Bar(progress, comparisons, quick)
        for number, one in enumerate(comparisons):
            _forget(one, folder)
            known.ended[one.name] = Ended(code=INTERRUPTED, took_s=0.0)  # until it ends
            known.interrupted = f"in {one.name}, after {number} of {len(comparisons)}"
            known.save(folder)
            bar.next(one)
            began = time.monotonic()
            code = _run(one, folder, quick, bar.tick)
            left = (folder / f"{one.name}.json").exists()
            ended = Ended(code=code, took_s=round(time.monotonic() - began, 1), results=left)
            known.ended[one.name], known.interrupted = ended, ""
            known.save(folder)
            took = f"{one.name}: {ended.took_s:.0f} s"
            console.print(", ".join(filter(None, (took, ended.wrong))), highlight=False, soft_wrap=True)


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
    return HUNG if hung else process.returncode


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
