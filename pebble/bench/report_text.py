"""What a report says: README.md from the comparisons' results and output. Pure."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from pebble.bench import null
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.report_limits import limits
from pebble.bench.report_plan import Comparison
from pebble.bench.results import Results

#: ``aim: <what>: met (<figure>)``, ``… missed by <figure>`` or ``… <figure>, met``
_AIM = re.compile(
    r"aim: (?P<aim>.+): (?:(?P<before>[^:]+), )?(?P<how>met|missed)(?P<by> by [^()]+)?(?: \((?P<figure>.*)\))?\.?"
)
_NULL = "-null"
_NOT_THE_TABLE = ("Written:", "No plots:")  # what a command says about its files
_LONG = 45  # lines of output: more are folded away
_TAIL = 12  # lines of a failed command's output


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One comparison: its results, or None when it left none; what it printed; its pictures with their captions."""

    comparison: Comparison
    results: Results | None
    said: str = ""
    pictures: Sequence[tuple[str, str]] = field(default_factory=tuple)

    @property
    def verdict(self) -> list[str]:
        """Without the aims."""
        return [line for line in self._lines() if not line.startswith("aim:")]

    @property
    def aims(self) -> list[tuple[str, str, str]]:
        """What was aimed at, met or missed, and the figure."""
        found = filter(None, map(_AIM.fullmatch, self._lines()))
        return [(one["aim"], one["how"], _figure(one["before"], one["by"], one["figure"])) for one in found]

    def _lines(self) -> list[str]:
        return [] if self.results is None else self.results.verdict


def text(sections: Sequence[Section]) -> str:
    """The whole document."""
    parts = [*_head(sections), *_summary(sections), *_aims(sections), *_machine(sections)]
    quick = any(results.quick for results in _measured(sections))
    for section in sections:
        parts += _section(section, quick)
    parts += ["## What these numbers do not show", "\n".join(f"* {line}" for line in limits(_measured(sections)))]
    return "\n\n".join(parts) + "\n"


def _measured(sections: Sequence[Section]) -> list[Results]:
    return [section.results for section in sections if section.results is not None]


def _head(sections: Sequence[Section]) -> Iterator[str]:
    measured = _measured(sections)
    quick = any(results.quick for results in measured)
    yield "# Results of a quick run" if quick else "# Results"
    if quick:
        yield (
            "**Quick: fewer cases, fewer and shorter rounds than a full report.** It shows that everything works, and "
            "differences that are large; nothing less."
        )
    minutes = sum(results.took_s for results in measured) / 60
    days = sorted({results.began[:10] for results in measured})
    yield (
        f"Measured on {' to '.join(dict.fromkeys((days[0], days[-1]))) if days else 'no day'}, in {minutes:.0f} min. "
        f"Everything here, this text included, is made by `make report{' QUICK=1' if quick else ''}`; every sample is "
        "in the `.json` beside each comparison's figures, with the options and versions it was taken with."
    )


def _summary(sections: Sequence[Section]) -> Iterator[str]:
    lines = []
    for section in sections:
        about = section.comparison
        if found := [f"  * {line}" for line in section.verdict[: about.choosing]]:
            lines += [f"* [{about.title}](#{_anchor(about.title)})", *found]
        elif section.results is None:
            lines.append(f"* [{about.title}](#{_anchor(about.title)}): **failed**, nothing was measured")
    lines += _nulls(sections)
    if lines:
        yield "## In short"
        yield "\n".join(lines)


def _nulls(sections: Sequence[Section]) -> list[str]:
    """Can what is above be believed?"""
    tests = [results for results in _measured(sections) if results.bench.endswith(_NULL)]
    if not tests:
        return []
    told = [f"{results.bench.removesuffix(_NULL)} {_null(results)}" for results in tests]
    return [f"* Null tests, the same against itself, and made a fifth slower: {', '.join(told)}"]


def _null(results: Results) -> str:
    if min((len(cell.rounds) for cell in results.cells), default=0) < LEAST_ROUNDS:
        return f"not judged, for that takes {LEAST_ROUNDS} rounds"
    return "passed" if null.passed(results.cells) else "**missed**"


def _aims(sections: Sequence[Section]) -> Iterator[str]:
    rows = [
        f"| {_cell(aim)} | [{section.comparison.name}](#{_anchor(section.comparison.title)}) "
        f"| {'met' if how == 'met' else '**missed**'} | {_cell(figure)} |"
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
            told = rows.setdefault(name, [])
            if str(value) not in told:
                told.append("not installed" if value is None else str(value))
    if rows:
        yield "## The machine"
        yield "\n".join(
            ["| | |", "|---|---|", *(f"| {name} | {_cell(' / '.join(told))} |" for name, told in rows.items())]
        )


def _section(section: Section, quick: bool) -> Iterator[str]:
    about, results = section.comparison, section.results
    yield f"## {about.title}"
    yield about.what
    command = shlex.join(results.command if results and results.command else ["pebble", *about.arguments(quick)])
    yield f"    {command}"
    if results is None:
        yield "**It failed and left no results.** The end of what it said:"
        yield _fenced(section.said.strip().splitlines()[-_TAIL:])
        return
    if results.quick:
        yield "A quick run."
    if results.verdict:
        yield "\n".join(f"* {line}" for line in results.verdict)
    for file, caption in section.pictures:
        yield f"![{caption}]({file})"
    yield from _output(section, results)


def _output(section: Section, results: Results) -> Iterator[str]:
    """Its tables. The verdict stands above already."""
    lines = [
        line.rstrip()
        for line in section.said.splitlines()
        if line.strip() not in results.verdict and not line.startswith(_NOT_THE_TABLE)
    ]
    while lines and not lines[-1]:
        lines.pop()
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
    """As GitHub makes them."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
