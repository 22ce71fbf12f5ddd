"""The text of a report: README.md from the comparisons' results and output. Pure."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from pebble.bench import null
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.report_limits import limits
from pebble.bench.report_plan import Comparison, title_of
from pebble.bench.report_run import Outcome, Run
from pebble.bench.results import Results

HEADING = "# Results"  # the first line of every report
#: ``aim: <what>: met (<figure>)``, ``… missed by <figure>``, ``… not judged (<figure>)`` or ``… <figure>, met``
_AIM = re.compile(
    r"aim: (?P<aim>.+): (?:(?P<before>[^:]+), )?(?P<how>met|missed|not judged)"
    r"(?P<by> by [^()]+)?(?: \((?P<figure>.*)\))?\.?"
)
_NULL = "-null"
_NOT_THE_TABLE = ("Written:", "No plots:")  # what a command prints about its files
_LONG = 45  # lines of output: more are collapsed
_TAIL = 12  # lines of a failed command's output


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One comparison: its results, if any; its output; its pictures with their captions."""

    comparison: Comparison
    results: Results | None
    output: str = ""
    ended: Outcome | None = None  # None: unknown
    pictures: Sequence[tuple[str, str]] = field(default_factory=tuple)

    @property
    def assessment(self) -> list[str]:
        """The sentences without the aims."""
        return [line for line in self._lines() if not line.startswith("aim:")]

    @property
    def aims(self) -> list[tuple[str, str, str]]:
        """Each aim, whether it was met, and the measured value."""
        found = filter(None, map(_AIM.fullmatch, self._lines()))
        return [(one["aim"], one["how"], _figure(one["before"], one["by"], one["figure"])) for one in found]

    @property
    def problem(self) -> str:
        """Why its command line failed; empty if it did not."""
        return "" if self.ended is None else self.ended.problem

    @property
    def took_s(self) -> float:
        if self.ended is not None:
            return self.ended.took_s
        return 0.0 if self.results is None else self.results.took_s

    @property
    def quick(self) -> bool:
        return self.results is not None and self.results.quick

    def _lines(self) -> list[str]:
        return [] if self.results is None else self.results.assessment


def text(sections: Sequence[Section], run: Run | None = None) -> str:
    """The whole report as Markdown."""
    run = run or Run()
    parts = [*_head(sections, run), *_summary(sections, run), *_aims(sections), *_machine(sections)]
    quick = any(section.quick for section in sections)
    for section in sections:
        parts += _section(section, quick)
    parts += ["## What these numbers do not show", "\n".join(f"* {line}" for line in limits(_measured(sections)))]
    return "\n\n".join(parts) + "\n"


def _measured(sections: Sequence[Section]) -> list[Results]:
    return [section.results for section in sections if section.results is not None]


def _head(sections: Sequence[Section], run: Run) -> Iterator[str]:
    measured = _measured(sections)
    quick = any(section.quick for section in sections)
    yield f"{HEADING} of a quick run" if quick else HEADING
    if quick:
        yield (
            "**Quick: fewer cases, fewer and shorter rounds than a full report.** It shows that everything works, and "
            "large differences only."
        )
    if quick and any(not one.quick and _has_quick(one) for one in sections):
        yield "**Not all of it is quick: it combines several runs. Each comparison names its date.**"
    if run.interrupted:
        yield (
            f"**The run was interrupted {run.interrupted} comparisons.** Later comparisons show the results of an "
            "earlier run."
        )
    days = sorted({results.began[:10] for results in measured})
    took = _span(sum(section.took_s for section in sections))
    when = f"Measured on {' to '.join(dict.fromkeys((days[0], days[-1])))}, in {took}. " if days else ""
    yield (
        f"{when}Everything here, including this text, is made by `make report{' QUICK=1' if quick else ''}`; every "
        "sample is in the `.json` file of its comparison, with the options and versions of the run."
    )


def _has_quick(section: Section) -> bool:
    about = section.comparison
    return section.results is not None and list(about.quick) != list(about.full)


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{seconds / 60:.0f} min" if minutes >= 10 else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _summary(sections: Sequence[Section], run: Run) -> Iterator[str]:
    lines = []
    for section in sections:
        about = section.comparison
        link = f"* [{about.title}](#{_anchor(about.title)})"
        found = [f"  * {line}" for line in section.assessment[: about.summary_lines]]
        if section.results is None:
            lines.append(f"{link}: **failed**, {section.problem or 'nothing was measured'}")
        elif section.problem:
            lines += [f"{link}: **incomplete**, it {section.problem}", *found]
        elif found:
            lines += [link, *found]
    lines += [f"* {title_of(name)}: left out, needs root" for name in run.left_out]
    lines += _null_tests(sections)
    if lines:
        yield "## In short"
        yield "\n".join(lines)


def _null_tests(sections: Sequence[Section]) -> list[str]:
    """One line with the results of the null tests."""
    tests = [results for results in _measured(sections) if results.bench.endswith(_NULL)]
    if not tests:
        return []
    shown = [f"{results.bench.removesuffix(_NULL)} {_null(results)}" for results in tests]
    return [f"* Null tests, each variant against itself and against itself slowed by a fifth: {', '.join(shown)}"]


def _null(results: Results) -> str:
    if any(interval.few for _, interval in null.intervals(results.cells)):
        return f"not judged (fewer than {LEAST_ROUNDS} rounds)"
    return "passed" if null.passed(results.cells) else "**missed**"


def _aims(sections: Sequence[Section]) -> Iterator[str]:
    rows = [
        f"| {_cell(aim)} | [{section.comparison.name}](#{_anchor(section.comparison.title)}) "
        f"| {'**missed**' if how == 'missed' else how} | {_cell(figure)} |"
        for section in sections
        for aim, how, figure in section.aims
    ]
    if rows:
        yield "## Aims"
        yield "\n".join(["| aim | comparison | | measured |", "|---|---|---|---|", *rows])


def _machine(sections: Sequence[Section]) -> Iterator[str]:
    measured = _measured(sections)
    rows: dict[str, list[str]] = {}
    for results in measured:
        for name, value in {**results.machine, "pebble": results.pebble}.items():
            shown = rows.setdefault(name, [])
            if str(value) not in shown:
                shown.append("not installed" if value is None else str(value))
    if rows:
        yield "## The machine"
        yield "\n".join(
            ["| | |", "|---|---|", *(f"| {name} | {_cell(' / '.join(shown))} |" for name, shown in rows.items())]
        )


def _section(section: Section, quick: bool) -> Iterator[str]:
    about, results = section.comparison, section.results
    yield f"## {about.title}"
    yield about.what
    command = shlex.join(results.command if results and results.command else ["pebble", *about.arguments(quick)])
    yield f"    {command}"
    if results is None:
        yield f"**It {section.problem or 'failed'}, and left no results.** The end of its output:"
        yield _fenced(section.output.strip().splitlines()[-_TAIL:])
        return
    if results.began:
        quickly = ", a quick run" if results.quick else ""
        yield f"Started {results.began[:10]} {results.began[11:16]} UTC, {_span(section.took_s)}{quickly}."
    if section.problem:
        yield f"**It {section.problem}: something could not be measured.** See its output."
    if results.assessment:
        yield "\n".join(f"* {line}" for line in results.assessment)
    for file, caption in section.pictures:
        yield f"![{caption}]({file})"
    yield from _output(section, results)


def _output(section: Section, results: Results) -> Iterator[str]:
    """The printed tables, without the assessment, which is above."""
    lines = [
        line.rstrip()
        for line in section.output.splitlines()
        if line.strip() not in results.assessment and not line.startswith(_NOT_THE_TABLE)
    ]
    while lines and not lines[-1]:
        lines.pop()
    while lines and not lines[0]:
        lines.pop(0)
    if not lines:
        return
    if len(lines) <= _LONG:
        yield _fenced(lines)
    else:
        yield f"<details><summary>The tables, {len(lines)} lines</summary>"
        yield _fenced(lines)
        yield "</details>"


def _figure(*parts: str | None) -> str:
    return ", ".join(part.strip() for part in parts if part)


def _fenced(lines: Sequence[str]) -> str:
    return "\n".join(["```text", *lines, "```"])


def _cell(words: str) -> str:
    return words.replace("|", "\\|")


def _anchor(title: str) -> str:
    """The anchor that GitHub generates for a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
