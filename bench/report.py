"""Runs the comparisons of a report, each as its own command line, and writes the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pebble.bench import catalogue
from pebble.bench.comparison import Comparison
from pebble.bench.engine import check_folder
from pebble.bench.report_text import HEADING, HUNG, INTERRUPTED, Outcome, Run, Section, text
from pebble.bench.results import load, named, pack
from pebble.errors import PebbleError
from pebble.rig.processes import python
from pebble.rig.programs import Program, end_all
from pebble.runtime.signals import interrupted_by_signals

NAME = "README.md"
_ENDED = "report.json"
#: Before a command: its tables are plain text of this width.
_PLAIN = ("env", "-u", "FORCE_COLOR", "-u", "TTY_COMPATIBLE", "COLUMNS=120", "NO_COLOR=1", "PYTHONUNBUFFERED=1")
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
    check_folder(folder)
    _check(folder)  # before an hour of measuring, not after it
    expected = sum(one.expected_s(quick) for one in comparisons)
    about = f"{expected / 60:.0f} min" if expected > 120 else f"{expected} s"
    console.print(f"{len(comparisons)} comparisons: about {about}", highlight=False)
    known = _known(folder)
    for one in left_out:
        _delete_results(one, folder)
        known.ended.pop(one.name, None)
    shown = {one.name for one in (*comparisons, *left_out)}
    known.left_out = [*(name for name in known.left_out if name not in shown), *(one.name for one in left_out)]
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


def write(folder: Path, *, redraw: bool = True) -> Path:
    """Writes README.md from the results in ``folder``, and the pictures: all with ``redraw``, else the missing ones.

    Raises PebbleError.
    """
    _check(folder)
    known = _known(folder)
    sections = [found for one in catalogue.reported() if (found := _section(one, folder, known, redraw)) is not None]
    if not sections:
        raise PebbleError(f"{folder} has no results of pebble bench: run pebble bench report {folder}")
    path = folder / NAME
    with named(path):
        path.write_text(text(sections, known))
    return path


def _check(folder: Path) -> None:
    """Raises PebbleError without matplotlib, or if README.md is not one of our reports and would be overwritten."""
    if find_spec("matplotlib") is None:
        raise PebbleError("a report needs matplotlib, which is not installed: pip install 'pebble-robot[bench]'")
    path = folder / NAME
    with named(path):
        ours = not path.exists() or path.read_text(errors="replace").startswith(HEADING)
    if not ours:
        raise PebbleError(f"{path} is not a report of pebble bench and would be overwritten: name another folder")


def _section(comparison: Comparison, folder: Path, known: Run, redraw: bool) -> Section | None:
    """None for a comparison without results and output."""
    from pebble.bench.pictures import draw, pictures

    output, measured = folder / f"{comparison.name}.txt", folder / f"{comparison.name}.json"
    words = output.read_text(errors="replace") if output.exists() else ""
    found = Section(comparison=comparison, results=None, output=words, ended=known.ended.get(comparison.name))
    if not measured.exists():
        return found if output.exists() else None
    try:
        results = load(measured)
    except PebbleError as error:  # of another version: the other sections are still written
        return replace(found, output=str(error))
    named = [(f"{picture.name}.png", picture.caption) for picture in pictures(results)]
    if redraw or not all((folder / name).exists() for name, _ in named):  # one that ran just now has drawn its own
        draw(results, folder)
    return replace(found, results=results, pictures=named)


def _measure(comparisons: Sequence[Comparison], folder: Path, quick: bool, known: Run, console: Console) -> None:
    """Runs all comparisons; each outcome is saved at once."""
    expected = [one.expected_s(quick) for one in comparisons]
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("", total=sum(expected))
        for number, one in enumerate(comparisons):
            about = f"{number + 1} of {len(comparisons)}: {one.name}, about {expected[number]} s"
            progress.update(bar, description=about, completed=sum(expected[:number]))
            _delete_results(one, folder)
            known.ended[one.name] = Outcome(code=INTERRUPTED, took_s=0.0)  # until it ends
            known.interrupted = f"in {one.name}, after {number} of {len(comparisons)}"
            _save(known, folder)
            began = time.monotonic()
            code = _run(one, folder, quick, partial(progress.advance, bar))
            left = (folder / f"{one.name}.json").exists()
            ended = Outcome(code=code, took_s=round(time.monotonic() - began, 1), results=left)
            known.ended[one.name], known.interrupted = ended, ""
            _save(known, folder)
            took = f"{one.name}: {ended.took_s:.0f} s"
            console.print(", ".join(filter(None, (took, ended.problem))), highlight=False, soft_wrap=True)


def _run(comparison: Comparison, folder: Path, quick: bool, advance: Callable[[float], None]) -> int:
    """Runs a comparison's command line and returns its exit code. The process ends with this one."""
    words = python("pebble.cli", *comparison.arguments(quick), "--output", folder)
    until = time.monotonic() + _TIMEOUT_FACTOR * comparison.expected_s(quick) + _TIMEOUT_EXTRA_S
    program = Program(comparison.name, [*_PLAIN, *words], folder / f"{comparison.name}.txt")
    try:
        while program.code is None and time.monotonic() < until:
            time.sleep(_POLL_S)
            advance(_POLL_S)
        return HUNG if program.code is None else program.code
    finally:
        end_all([program], _END_S)


def _delete_results(comparison: Comparison, folder: Path) -> None:
    """Deletes the results of an earlier run, so that a failure is not hidden by them."""
    from pebble.bench.pictures import pictures

    measured, old = folder / f"{comparison.name}.json", list[str]()
    with suppress(PebbleError):  # of another format: its pictures, if any, will be overwritten
        old = [f"{picture.name}.png" for picture in pictures(load(measured))] if measured.exists() else []
    for name in (*old, measured.name, f"{comparison.name}.txt"):
        (folder / name).unlink(missing_ok=True)


# -- how the comparisons ended: stored beside their results, since a result file does not contain it


def _save(known: Run, folder: Path) -> None:
    path = folder / _ENDED
    with named(path):
        path.write_bytes(msgspec.json.format(msgspec.json.encode(known)) + b"\n")


def _known(folder: Path) -> Run:
    """The state of a folder; empty without the file. Raises PebbleError for an invalid file."""
    path = folder / _ENDED
    try:
        return msgspec.json.decode(path.read_bytes(), type=Run) if path.exists() else Run()
    except (OSError, msgspec.DecodeError) as error:
        raise PebbleError(f"{path} cannot be read: {error}") from None
