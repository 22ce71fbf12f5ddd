"""Runs the comparisons of a report, each as its own command line, and writes the report."""

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

from pebble.bench import catalogue, report_run
from pebble.bench.comparison import Comparison
from pebble.bench.engine import check_folder
from pebble.bench.report_run import HUNG, INTERRUPTED, Outcome, Run
from pebble.bench.report_text import HEADING, Section, text
from pebble.bench.results import Results, load, pack
from pebble.errors import PebbleError
from pebble.runtime.parent import tied_to_parent
from pebble.runtime.signals import interrupted_by_signals

NAME = "README.md"
_WIDTH = 120  # characters of the comparisons' tables
_POLL_S = 0.2
_TIMEOUT_FACTOR = 4  # a comparison that takes this many times the expected time,
_TIMEOUT_EXTRA_S = 60.0  # and this in addition, is ended
_END_S = 20.0  # for a comparison to end its processes


def run(
    comparisons: Sequence[Comparison],
    folder: Path,
    *,
    quick: bool,
    left_out: Sequence[Comparison] = (),
    console: Console | None = None,
) -> int:
    """Measures and writes; returns 0 if every comparison succeeded. A failed one does not stop the others.

    The report lists what is ``left_out``, and earlier results of it are deleted. Raises PebbleError if the folder
    cannot be written.
    """
    console = console or Console()
    _require_matplotlib()  # before an hour of measuring, not after it
    check_folder(folder)
    _check_not_foreign(folder)
    expected = sum(one.expected_s(quick) for one in comparisons)
    about = f"{expected / 60:.0f} min" if expected > 120 else f"{expected} s"
    console.print(f"{len(comparisons)} comparisons: about {about}", highlight=False)
    known = _begin(comparisons, left_out, folder)
    try:
        with interrupted_by_signals():
            _measure(comparisons, folder, quick, known, console)
    except KeyboardInterrupt:
        with suppress(PebbleError):  # there are no results yet
            write(folder, redraw=False)
        raise
    write(folder, redraw=False)
    pack(folder)
    console.print(f"Written: {folder / NAME}", highlight=False, soft_wrap=True)
    failed = {one.name: problem for one in comparisons if (problem := known.ended[one.name].problem)}
    for name, why in failed.items():
        console.print(f"{name} {why}: see {folder / name}.txt", style="red", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _begin(comparisons: Sequence[Comparison], left_out: Sequence[Comparison], folder: Path) -> Run:
    """Loads the state of the folder, without the comparisons to be measured now or left out."""
    known = report_run.load(folder)
    for one in left_out:
        _delete_results(one, folder)
        known.ended.pop(one.name, None)
    shown = {one.name for one in (*comparisons, *left_out)}
    known.left_out = [*(name for name in known.left_out if name not in shown), *(one.name for one in left_out)]
    return known


def write(folder: Path, *, redraw: bool = True) -> Path:
    """Writes README.md from the results in ``folder``, and the pictures: all with ``redraw``, else the missing ones.

    Raises PebbleError.
    """
    _require_matplotlib()
    _check_not_foreign(folder)
    known = report_run.load(folder)
    sections = [
        section for one in catalogue.reported() if (section := _section(one, folder, known, redraw)) is not None
    ]
    if not sections:
        raise PebbleError(f"{folder} has no results of pebble bench: run pebble bench report {folder}")
    path = folder / NAME
    try:
        path.write_text(text(sections, known))
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    return path


def _require_matplotlib() -> None:
    if find_spec("matplotlib") is None:
        raise PebbleError("a report needs matplotlib, which is not installed: pip install 'pebble-robot[bench]'")


def _check_not_foreign(folder: Path) -> None:
    """Raises PebbleError if README.md is not one of our reports, which would be overwritten."""
    path = folder / NAME
    try:
        ours = not path.exists() or path.read_text(errors="replace").startswith(HEADING)
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    if not ours:
        raise PebbleError(f"{path} is not a report of pebble bench and would be overwritten: name another folder")


def _section(comparison: Comparison, folder: Path, known: Run, redraw: bool) -> Section | None:
    """None for a comparison without results and output."""
    output, measured = folder / f"{comparison.name}.txt", folder / f"{comparison.name}.json"
    if not output.exists() and not measured.exists():
        return None
    words = output.read_text(errors="replace") if output.exists() else ""
    ended = known.ended.get(comparison.name)
    if not measured.exists():
        return Section(comparison=comparison, results=None, output=words, ended=ended)
    try:
        results = load(measured)
    except PebbleError as error:  # of another version: the other sections are still written
        return Section(comparison=comparison, results=None, output=str(error), ended=ended)
    pictures = _pictures(results, folder, redraw)
    return Section(comparison=comparison, results=results, output=words, ended=ended, pictures=pictures)


def _pictures(results: Results, folder: Path, redraw: bool) -> list[tuple[str, str]]:
    """Files and captions. A comparison that was run just now has already drawn its pictures."""
    from pebble.bench.plots import draw, pictures

    named = [(f"{picture.name}.png", picture.caption) for picture in pictures(results)]
    if redraw or not all((folder / name).exists() for name, _ in named):
        draw(results, folder)
    return named


class _Bar:
    """The progress of the whole report, by expected times."""

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
    """Runs all comparisons; each outcome is saved at once."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = _Bar(progress, comparisons, quick)
        for number, one in enumerate(comparisons):
            _delete_results(one, folder)
            known.ended[one.name] = Outcome(code=INTERRUPTED, took_s=0.0)  # until it ends
            known.interrupted = f"in {one.name}, after {number} of {len(comparisons)}"
            known.save(folder)
            bar.next(one)
            began = time.monotonic()
            code = _run(one, folder, quick, bar.tick)
            left = (folder / f"{one.name}.json").exists()
            ended = Outcome(code=code, took_s=round(time.monotonic() - began, 1), results=left)
            known.ended[one.name], known.interrupted = ended, ""
            known.save(folder)
            took = f"{one.name}: {ended.took_s:.0f} s"
            console.print(", ".join(filter(None, (took, ended.problem))), highlight=False, soft_wrap=True)


def _run(comparison: Comparison, folder: Path, quick: bool, tick: Callable[[float], None]) -> int:
    """Runs a comparison's command line and returns its exit code. The process ends with this one."""
    words = [*comparison.arguments(quick), "--output", str(folder)]
    began, longest = time.monotonic(), _TIMEOUT_FACTOR * comparison.expected_s(quick) + _TIMEOUT_EXTRA_S
    path = folder / f"{comparison.name}.txt"
    with path.open("wb") as output:
        process = subprocess.Popen(
            tied_to_parent([sys.executable, "-m", "pebble.cli", *words], signal.SIGTERM),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # only this process handles Ctrl-C
            env=_plain(os.environ),
        )
        try:
            while process.poll() is None and time.monotonic() - began < longest:
                tick(time.monotonic() - began)
                time.sleep(_POLL_S)
            hung = process.poll() is None
        finally:
            _end(process)
    return HUNG if hung else process.returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    """Terminates the process, which ends its own processes; kills the group after a timeout."""
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _plain(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for plain-text tables of a fixed width."""
    retained = {name: value for name, value in environment.items() if name not in ("FORCE_COLOR", "TTY_COMPATIBLE")}
    return {**retained, "COLUMNS": str(_WIDTH), "NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}


def _delete_results(comparison: Comparison, folder: Path) -> None:
    """Deletes the results of an earlier run, so that a failure is not hidden by them."""
    from pebble.bench.plots import pictures

    measured = folder / f"{comparison.name}.json"
    try:
        old = [f"{picture.name}.png" for picture in pictures(load(measured))] if measured.exists() else []
    except PebbleError:  # of another format: its pictures, if any, will be overwritten
        old = []
    for name in (*old, measured.name, f"{comparison.name}.txt"):
        (folder / name).unlink(missing_ok=True)
