"""Runs the comparisons of a report, each as its own command line, and writes the report: README.md and its pictures."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from pebble.bench.aims import MISSED
from pebble.bench.comparison import Comparison, reported
from pebble.bench.engine import check_folder
from pebble.bench.results import Results, load, named, pack
from pebble.errors import PebbleError
from pebble.rig.processes import Program, end_all, python
from pebble.runtime.signals import interrupted_by_signals

NAME = "README.md"
_HEADING = "# Results"  # the first line of every report
#: Before a command: its tables are plain text of this width.
_PLAIN = ("env", "-u", "FORCE_COLOR", "-u", "TTY_COMPATIBLE", "COLUMNS=120", "NO_COLOR=1", "PYTHONUNBUFFERED=1")
_POLL_S = 0.2
_TIMEOUT_FACTOR = 4  # a comparison that takes this many times the expected time,
_TIMEOUT_EXTRA_S = 60.0  # and this in addition, is ended
_END_S = 20.0  # for a comparison to end its processes
_NOT_THE_TABLE = ("Written:", "No plots:")  # what a command prints about its files
_LONG = 45  # lines of output: more are collapsed
_TAIL = 12  # lines of a failed command's output
_BOLD = {MISSED: f"**{MISSED}**"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One comparison: its results, if any; its output; its pictures with their captions."""

    comparison: Comparison
    results: Results | None
    output: str = ""
    pictures: Sequence[tuple[str, str]] = ()

    @property
    def link(self) -> str:
        """The anchor that GitHub generates for its heading."""
        return "#" + re.sub(r"[^\w\- ]", "", self.comparison.title.lower()).replace(" ", "-")


# -- measuring


def run(comparisons: Sequence[Comparison], folder: Path, *, quick: bool, console: Console | None = None) -> int:
    """Measures and writes; returns 0 if every comparison succeeded. A failed one does not stop the others.

    Raises PebbleError if the folder cannot be written.
    """
    console, failed = console or Console(), 0
    check_folder(folder)
    _check(folder)  # before an hour of measuring, not after it
    expected = sum(one.expected_s(quick) for one in comparisons)
    console.print(f"{len(comparisons)} comparisons: about {_span(expected)}", highlight=False)
    try:
        with interrupted_by_signals():
            for number, one in enumerate(comparisons, 1):
                began = time.monotonic()
                with console.status(f"{number} of {len(comparisons)}: {one.name}, about {one.expected_s(quick)} s"):
                    problem = _run(one, folder, quick)
                line = f"{one.name} {problem}: see {folder / one.name}.txt" if problem else one.name
                console.print(f"{line}, {_span(time.monotonic() - began)}", highlight=False, soft_wrap=True)
                failed += bool(problem)
    except KeyboardInterrupt:
        with suppress(PebbleError):  # there are no results yet
            write(folder)
        raise
    pack(folder)
    console.print(f"Written: {write(folder)}", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _run(comparison: Comparison, folder: Path, quick: bool) -> str:
    """Runs a comparison's command line; returns why it failed. The process ends with this one.

    Results of an earlier run are deleted, so that a failure is not hidden by them.
    """
    results, output = (folder / f"{comparison.name}{ending}" for ending in (".json", ".txt"))
    for path in (results, output):
        path.unlink(missing_ok=True)
    words = python("pebble.cli", *comparison.arguments(quick), "--output", folder)
    until = time.monotonic() + _TIMEOUT_FACTOR * comparison.expected_s(quick) + _TIMEOUT_EXTRA_S
    program = Program(comparison.name, [*_PLAIN, *words], output)
    try:
        while program.code is None and time.monotonic() < until:
            time.sleep(_POLL_S)
        code = program.code
    finally:
        end_all([program], _END_S)
    if code is None:
        with output.open("a") as file:
            file.write(f"{comparison.name} hung and was ended\n")
        return "hung and was ended"
    return f"ended with code {code}" if code else "" if results.exists() else "measured nothing"


# -- writing


def write(folder: Path) -> Path:
    """Writes README.md and the pictures from the results in ``folder``. Raises PebbleError."""
    _check(folder)
    sections = [found for one in reported() if (found := _section_of(one, folder)) is not None]
    if not sections:
        raise PebbleError(f"{folder} has no results of pebble bench: run pebble bench report {folder}")
    path = folder / NAME
    with named(path):
        path.write_text(text(sections))
    return path


def _check(folder: Path) -> None:
    """Raises PebbleError without matplotlib, or if README.md is not one of our reports and would be overwritten."""
    if find_spec("matplotlib") is None:
        raise PebbleError("a report needs matplotlib, which is not installed: pip install 'pebble-robot[bench]'")
    path = folder / NAME
    if path.exists() and not path.read_text(errors="replace").startswith(_HEADING):
        raise PebbleError(f"{path} is not a report of pebble bench and would be overwritten: name another folder")


def _section_of(comparison: Comparison, folder: Path) -> Section | None:
    """Draws its pictures. None for a comparison without results and output."""
    from pebble.bench.pictures import draw

    measured, output = (folder / f"{comparison.name}{ending}" for ending in (".json", ".txt"))
    if not measured.exists() and not output.exists():
        return None
    words = output.read_text(errors="replace") if output.exists() else ""
    try:
        results = load(measured)
    except PebbleError as error:  # it failed, or is of another version: the other sections are still written
        words = words if not measured.exists() else str(error)
        return Section(comparison=comparison, results=None, output=words)
    pictures = [(path.name, picture.caption) for path, picture in draw(results, folder).items()]
    return Section(comparison=comparison, results=results, output=words, pictures=pictures)


# -- the text


def text(sections: Sequence[Section]) -> str:
    """The whole report as Markdown."""
    measured = [section.results for section in sections if section.results is not None]
    quick = any(results.quick for results in measured)
    parts = [*_head(measured, quick), *_summary(sections), *_aims(sections), *_machine(measured)]
    parts += [part for section in sections for part in _section(section, quick)]
    return "\n\n".join([*parts, *_limits(measured)]) + "\n"


def _listed(lines: Iterable[object]) -> str:
    return "\n".join(f"* {line}" for line in lines)


def _head(measured: Sequence[Results], quick: bool) -> Iterator[str]:
    yield f"{_HEADING} of a quick run" if quick else _HEADING
    if quick:
        yield (
            "**Quick: fewer cases, fewer and shorter rounds than a full report.** It shows that everything works, and "
            "large differences only: “equal within noise” mostly means that there was not enough time to measure one."
        )
    days = sorted({results.began[:10] for results in measured})
    took = _span(sum(results.took_s for results in measured))
    when = f"Measured on {' to '.join(dict.fromkeys((days[0], days[-1])))}, in {took}. " if days else ""
    yield (
        f"{when}Everything here, including this text, is made by `make report{' QUICK=1' if quick else ''}`; each "
        "comparison has a `.json` file with the options and versions of the run; the samples are in `samples.json.xz`, "
        "at most 2,000 of each case, taken so that percentiles stay as they were."
    )


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{seconds / 60:.0f} min" if minutes >= 10 else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _summary(sections: Sequence[Section]) -> Iterator[str]:
    lines = []
    for section in sections:
        about, results = section.comparison, section.results
        state = ": **failed**" if results is None else "" if results.complete else ": **incomplete**"
        found = [] if results is None else [f"  * {line}" for line in results.assessment[: about.summary_lines]]
        if state or found:
            lines.append("\n".join((f"[{about.title}]({section.link}){state}", *found)))
    if lines:
        yield "## In short"
        yield _listed(lines)


def _aims(sections: Sequence[Section]) -> Iterator[str]:
    rows = [
        (aim.what, f"[{section.comparison.name}]({section.link})", _BOLD.get(aim.outcome, aim.outcome), aim.measured)
        for section in sections
        if section.results is not None
        for aim in section.results.aims
    ]
    if rows:
        yield "## Aims"
        yield _table(("aim", "comparison", "", "measured"), rows)


def _machine(measured: Sequence[Results]) -> Iterator[str]:
    """That of the first comparison: a result file has its own."""
    for results in measured[:1]:
        yield "## The machine"
        rows = {**results.machine, "pebble": results.pebble}
        yield _table(("", ""), [(name, str(value or "not installed")) for name, value in rows.items()])


def _section(section: Section, quick: bool) -> Iterator[str]:
    about, results = section.comparison, section.results
    yield f"## {about.title}"
    yield about.what
    command = results.command if results and results.command else ["pebble", *about.arguments(quick)]
    yield f"    {shlex.join(command)}"
    if results is None:
        yield "**It failed, and left no results.** The end of its output:"
        yield _fenced(section.output.strip().splitlines()[-_TAIL:])
        return
    if results.began:
        quickly = ", a quick run" if results.quick else ""
        yield f"Started {results.began[:10]} {results.began[11:16]} UTC, {_span(results.took_s)}{quickly}."
    if not results.complete:
        yield "**Something could not be measured.** See its output."
    if lines := [*results.assessment, *map(str, results.aims)]:
        yield _listed(lines)
    for file, caption in section.pictures:
        yield f"![{caption}]({file})"
    printed = (line.rstrip() for line in section.output.splitlines() if not line.startswith(_NOT_THE_TABLE))
    tables = "\n".join(line for line in printed if line.strip() not in lines).strip("\n").splitlines()
    if len(tables) > _LONG:
        yield f"<details><summary>The tables, {len(tables)} lines</summary>"
    if tables:
        yield _fenced(tables)
    if len(tables) > _LONG:
        yield "</details>"


def _fenced(lines: Sequence[str]) -> str:
    return "\n".join(["```text", *lines, "```"])


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    escaped = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in (heads, *rows))
    first, *lines = (f"| {line} |".replace("|  |", "| |") for line in escaped)
    return "\n".join((first, "|" + "---|" * len(heads), *lines))


_NO_REAL = (
    "No radio. Every byte went over loopback or a veth pair; profiles imitate the effects of Wi-Fi on bandwidth, delay "
    "and loss, not their cause.",
    "No second machine. Both ends use the same clock and cores: brokers, operators and the measuring programs compete "
    "with the robot.",
    "No Raspberry Pi: its cores are slower, and throttle when hot. Ratios between variants transfer better than times.",
    "No camera and no microphone. A moving scene and speech are synthetic; real ones are noisier, which costs bytes.",
    "No hardware encoder. H.264 is x264 on the CPU, as on a robot without one.",
    "No MCU. Its end of the serial line is a simulated board on a pty, which has no baud rate: at 115,200 baud a "
    "command's line of about 15 bytes takes another 1.3 ms, on each transport alike.",
    "No other language. Both ends are Python, with paho and with Zenoh's Python binding.",
    "No large network: no router between hub and peers, no TLS, no other robots on the broker, except in the fleet.",
    "No long run: leaks, and brokers that have run for a month, are not covered.",
    "A null test shows that a comparison finds no difference where there is none, not the cause of those it finds.",
)


def _limits(measured: Sequence[Results]) -> Iterator[str]:
    machine = measured[0].machine if measured else {}
    yield "## What these numbers do not show"
    this_machine = (
        f"One machine, {machine.get('cores')} cores of {machine.get('cpu')}. Intervals are over the rounds of one run; "
        "another run, another kernel or another load on the same host changes medians by more than they show."
    )
    yield _listed((this_machine, *_NO_REAL))
