"""Runs the comparisons of a report, each as its own command line, and writes the report: README.md and its pictures."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from pebble.bench.comparison import Comparison, reported
from pebble.bench.engine import check_folder
from pebble.bench.judging.aims import MISSED
from pebble.bench.results import Results, load, named, pack
from pebble.errors import PebbleError
from pebble.rig.processes import Program, end_all, python
from pebble.runtime.signals import interrupted_by_signals

NAME = "README.md"
_HEADING = "# Results"  # the first line of every report
#: Before a command: its tables are plain text of this width.
_PLAIN = ("env", "-u", "FORCE_COLOR", "-u", "TTY_COMPATIBLE", "COLUMNS=120", "NO_COLOR=1", "PYTHONUNBUFFERED=1")
_POLL_S = 0.2
TIMEOUT_FACTOR = 4  # a comparison that takes this many times the expected time,
TIMEOUT_EXTRA_S = 60.0  # and this in addition, is ended
_END_S = 20.0  # for a comparison to end its processes
_NOT_THE_TABLE = ("Written:", "No plots:")  # what a command prints about its files
#: What a report begins with: pictures, and by comparison the sentence that says most.
_PICTURES = ("bridge-down.png", "impair-audio-delivery.png")
_SENTENCES = {
    "control": r"p50: ",
    "bridge": r"Median, down, load none: ",
    "cost": r"idle, memory: ",
    "frames": r"640x480, one reader: .* of mqtt ",
    "impair": r"Sound that arrived within a second at 64k",
}
_LONG = 45  # lines of output: more are collapsed
_TAIL = 12  # lines of a failed command's output


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One comparison: its results, if any; its output; its pictures with their captions."""

    comparison: Comparison
    results: Results | None
    output: str = ""
    pictures: Sequence[tuple[str, str]] = ()

    def link(self, text: str) -> str:
        """To its heading, by the anchor that GitHub generates."""
        anchor = re.sub(r"[^\w\- ]", "", self.comparison.title.lower()).replace(" ", "-")
        return f"[{text}](#{anchor})"


def run(comparisons: Sequence[Comparison], folder: Path, *, quick: bool, console: Console | None = None) -> int:
    """Measures and writes; returns 0 if every comparison succeeded. A failed one does not stop the others.

    Raises PebbleError if the folder cannot be written.
    """
    console, failed = console or Console(highlight=False), 0
    check_folder(folder)
    _check(folder)  # before an hour of measuring, not after it
    console.print(f"{len(comparisons)} comparisons: about {_span(sum(one.expected_s(quick) for one in comparisons))}")
    try:
        with interrupted_by_signals():
            for number, one in enumerate(comparisons, 1):
                began = time.monotonic()
                with console.status(f"{number} of {len(comparisons)}: {one.name}, about {one.expected_s(quick)} s"):
                    problem = run_one(one, folder, quick)
                line = f"{one.name} {problem}: see {folder / one.name}.txt" if problem else one.name
                console.print(f"{line}, {_span(time.monotonic() - began)}", soft_wrap=True)
                failed += bool(problem)
    finally:  # also after Ctrl-C
        pack(folder)
        console.print(f"Written: {write(folder)}", soft_wrap=True)
    return 1 if failed else 0


def run_one(comparison: Comparison, folder: Path, quick: bool) -> str:
    """Runs a comparison's command line; returns why it failed. The process ends with this one."""
    results, output = _files(comparison, folder)
    for path in (results, output):  # of an earlier run: they would hide a failure
        path.unlink(missing_ok=True)
    words = python("pebble.cli", *comparison.arguments(quick), "--output", folder)
    until = time.monotonic() + TIMEOUT_FACTOR * comparison.expected_s(quick) + TIMEOUT_EXTRA_S
    program = Program(comparison.name, [*_PLAIN, *words], output)
    try:
        while (code := program.code) is None and time.monotonic() < until:
            time.sleep(_POLL_S)
    finally:
        end_all([program], _END_S)
    if code is None:
        return "hung and was ended"
    return f"ended with code {code}" if code else "" if results.exists() else "measured nothing"


def _files(comparison: Comparison, folder: Path) -> tuple[Path, Path]:
    return folder / f"{comparison.name}.json", folder / f"{comparison.name}.txt"


def write(folder: Path) -> Path:
    """Writes README.md and the pictures from the results in ``folder``. Raises PebbleError."""
    _check(folder)
    sections = [_section_of(one, folder) for one in reported() if any(file.exists() for file in _files(one, folder))]
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


def _section_of(comparison: Comparison, folder: Path) -> Section:
    """Draws its pictures."""
    from pebble.bench.pictures import draw

    measured, output = _files(comparison, folder)
    words = output.read_text(errors="replace") if output.exists() else ""
    try:
        results = load(measured)
    except PebbleError as error:  # it failed, or is of another version: the other sections are still written
        return Section(comparison=comparison, results=None, output=str(error) if measured.exists() else words)
    pictures = [(path.name, picture.caption) for path, picture in draw(results, folder).items()]
    return Section(comparison=comparison, results=results, output=words, pictures=pictures)


def text(sections: Sequence[Section]) -> str:
    """The whole report as Markdown."""
    measured = [section.results for section in sections if section.results is not None]
    parts = [*_head(measured), *_summary(sections)]
    rows = [
        (aim.what, section.link(section.comparison.name), aim.outcome.replace(MISSED, f"**{MISSED}**"), aim.measured)
        for section in sections
        for aim in (section.results.aims if section.results else ())
    ]
    parts += ["## Aims", _table(("aim", "comparison", "", "measured"), rows)] if rows else []
    for results in measured[:1]:  # each result file has its own
        machine = {**results.machine, "pebble": results.pebble}
        parts += ["## The machine", _table(("", ""), [(name, str(value or "–")) for name, value in machine.items()])]
    for section in sections:
        parts += _section(section)
    return "\n\n".join([*parts, "## What these numbers do not show", _listed(_LIMITS)]) + "\n"


def _head(measured: Sequence[Results]) -> Iterator[str]:
    quick = any(results.quick for results in measured)
    yield f"{_HEADING} of a quick run" if quick else _HEADING
    days = sorted({results.began[:10] for results in measured})
    took = _span(sum(results.took_s for results in measured))
    when = f"Measured on {' to '.join(dict.fromkeys((days[0], days[-1])))}, in {took}. " if days else ""
    yield (
        f"{when}All of this is made by `make report{' QUICK=1' if quick else ''}`. Options and versions are in `.json` "
        "files, up to 2,000 samples of each case, or 100 of each round, in `samples.json.xz`."
    )


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{seconds / 60:.0f} min" if minutes >= 10 else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _summary(sections: Sequence[Section]) -> Iterator[str]:
    """The pictures and sentences that say most, and which comparisons have failed."""
    pictures = {file: caption for section in sections for file, caption in section.pictures}
    yield from (f"![{pictures[file]}]({file})" for file in _PICTURES if file in pictures)
    if lines := [line for section in sections for line in _found(section)]:
        yield _listed(lines)


def _found(section: Section) -> Iterator[str]:
    title, results = section.link(section.comparison.title), section.results
    if results is None or not results.complete:
        yield f"{title}: **{'failed' if results is None else 'incomplete'}**"
    if results is not None and (pattern := _SENTENCES.get(section.comparison.name)):
        most = next((line for line in results.assessment if re.match(pattern, line)), None)
        yield from () if most is None else (f"{title}: {most}",)


def _section(section: Section) -> Iterator[str]:
    about, results = section.comparison, section.results
    yield f"## {about.title}"
    yield about.what
    if results is None:
        yield "**It failed, and left no results.** The end of its output:"
        yield _fenced(section.output.strip().splitlines()[-_TAIL:])
        return
    yield f"    {shlex.join(results.command)}"
    quickly = ", a quick run" if results.quick else ""
    yield f"Started {results.began[:10]} {results.began[11:16]} UTC, {_span(results.took_s)}{quickly}."
    if not results.complete:
        yield "**Something could not be measured.** See its output."
    if results.assessment:
        yield _listed(results.assessment)
    yield from (f"![{caption}]({file})" for file, caption in section.pictures)
    printed = (line.rstrip() for line in section.output.splitlines() if not line.startswith(_NOT_THE_TABLE))
    shown = {*results.assessment, *map(str, results.aims)}  # above, and in the table of all aims
    tables = "\n".join(line for line in printed if line.strip() not in shown).strip("\n").splitlines()
    folded = [f"<details><summary>The tables, {len(tables)} lines</summary>", _fenced(tables), "</details>"]
    yield from folded if len(tables) > _LONG else folded[1:2] if tables else []


def _listed(lines: Iterable[object]) -> str:
    return "\n".join(f"* {line}" for line in lines)


def _fenced(lines: Sequence[str]) -> str:
    return "\n".join(["```text", *lines, "```"])


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in (heads, ["---"] * len(heads), *rows))
    return "\n".join(f"| {line} |" for line in lines)


_LIMITS = (
    "One machine. Intervals are over the rounds of one run; another run, kernel or load changes medians by more.",
    "No radio: all went over loopback, veth pairs and TUN devices. Profiles imitate effects of Wi-Fi, not their cause.",
    "No second machine: brokers, operators and the measuring programs compete with the robot for the same cores.",
    "No Raspberry Pi: its cores are slower, and throttle when hot. Ratios between variants transfer better than times.",
    "No camera, microphone and hardware encoder: real pictures and sounds are noisier than ours, which costs bytes.",
    "No MCU: its serial line is a pty without a baud rate; at 115,200 baud a command takes another 1.3 ms.",
    "No other language than Python, no TLS, no large network, and no long run.",
    "A null test shows that a comparison finds no difference where there is none, not the cause of those it finds.",
)
