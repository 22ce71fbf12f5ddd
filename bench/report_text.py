"""The text of a report: README.md from the comparisons' results and output. Pure."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import msgspec

from pebble.bench import catalogue, null
from pebble.bench.aims import MISSED
from pebble.bench.comparison import Comparison
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.results import Results

HEADING = "# Results"  # the first line of every report
_NULL = "-null"
_NOT_THE_TABLE = ("Written:", "No plots:")  # what a command prints about its files
_LONG = 45  # lines of output: more are collapsed
_BOLD = {MISSED: f"**{MISSED}**"}
_PIPE = "\\|"
_TAIL = 12  # lines of a failed command's output

HUNG, INTERRUPTED = -1, -2
_WHY = {HUNG: "hung and was ended", INTERRUPTED: "was interrupted"}


class Outcome(msgspec.Struct, kw_only=True):
    """One command line of a report: its exit code, and how long it took with all its processes."""

    code: int
    took_s: float
    results: bool = True  # whether it wrote results

    @property
    def problem(self) -> str:
        """Why it failed; empty if it did not."""
        if self.code:
            return _WHY.get(self.code, f"ended with code {self.code}")
        return "" if self.results else "measured nothing"


class Run(msgspec.Struct, kw_only=True):
    """The runs that wrote into a folder, by the names of the comparisons."""

    ended: dict[str, Outcome] = {}
    left_out: list[str] = []  # not permitted for this user
    interrupted: str = ""  # in which comparison, after how many


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One comparison: its results, if any; its output; its pictures with their captions."""

    comparison: Comparison
    results: Results | None
    output: str = ""
    ended: Outcome | None = None  # None: unknown
    pictures: Sequence[tuple[str, str]] = ()

    @property
    def link(self) -> str:
        """The anchor that GitHub generates for its heading."""
        return "#" + re.sub(r"[^\w\- ]", "", self.comparison.title.lower()).replace(" ", "-")

    @property
    def problem(self) -> str:
        """Why its command line failed; empty if it did not."""
        return "" if self.ended is None else self.ended.problem

    @property
    def took_s(self) -> float:
        known = self.ended or self.results
        return 0.0 if known is None else known.took_s


def text(sections: Sequence[Section], run: Run | None = None) -> str:
    """The whole report as Markdown."""
    run, measured = run or Run(), [section.results for section in sections if section.results is not None]
    quick = any(results.quick for results in measured)
    parts = [*_head(sections, measured, quick, run), *_summary(sections, measured, run), *_aims(sections)]
    parts += [*_machine(measured), *(part for section in sections for part in _section(section, quick))]
    parts += ["## What these numbers do not show", _listed(limits(measured))]
    return "\n\n".join(parts) + "\n"


def _listed(lines: Iterable[object]) -> str:
    return "\n".join(f"* {line}" for line in lines)


def _head(sections: Sequence[Section], measured: Sequence[Results], quick: bool, run: Run) -> Iterator[str]:
    yield f"{HEADING} of a quick run" if quick else HEADING
    if quick:
        yield (
            "**Quick: fewer cases, fewer and shorter rounds than a full report.** It shows that everything works, and "
            "large differences only."
        )
    if quick and any(one.results and not one.results.quick and one.comparison.has_quick for one in sections):
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
        f"{when}Everything here, including this text, is made by `make report{' QUICK=1' if quick else ''}`; each "
        "comparison has a `.json` file with the options and versions of the run; the samples are in `samples.json.xz`, "
        "at most 2,000 of each case, taken so that percentiles stay as they were."
    )


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{seconds / 60:.0f} min" if minutes >= 10 else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _summary(sections: Sequence[Section], measured: Sequence[Results], run: Run) -> Iterator[str]:
    lines = []
    for section in sections:
        about, results = section.comparison, section.results
        link, why = f"[{about.title}]({section.link})", section.problem
        found = [] if results is None else [f"  * {line}" for line in results.assessment[: about.summary_lines]]
        if results is None:
            link += f": **failed**, {why or 'nothing was measured'}"
        elif why:
            link += f": **incomplete**, it {why}"
        if results is None or why or found:
            lines.append("\n".join((link, *found)))
    lines += [f"{catalogue.find(name).title}: left out, needs root" for name in run.left_out]
    tests = [f"{one.bench.removesuffix(_NULL)} {_null(one)}" for one in measured if one.bench.endswith(_NULL)]
    if tests:
        lines.append(
            f"Null tests, each variant against itself and against itself slowed by a fifth: {', '.join(tests)}"
        )
    if lines:
        yield "## In short"
        yield _listed(lines)


def _null(results: Results) -> str:
    if any(interval.few for _, interval in null.intervals(results.cells)):
        return f"not judged (fewer than {LEAST_ROUNDS} rounds)"
    return "passed" if null.passed(results.cells) else "**missed**"


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
    rows: dict[str, dict[str, None]] = {}
    for results in measured:
        for name, value in {**results.machine, "pebble": results.pebble}.items():
            rows.setdefault(name, {})["not installed" if value is None else str(value)] = None
    if rows:
        yield "## The machine"
        yield _table(("", ""), [(name, " / ".join(shown)) for name, shown in rows.items()])


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
    if lines := [*results.assessment, *results.aims]:
        yield _listed(lines)
    for file, caption in section.pictures:
        yield f"![{caption}]({file})"
    yield from _output(section, results)


def _output(section: Section, results: Results) -> Iterator[str]:
    """The printed tables, without the assessment, which is above."""
    known = {*results.assessment, *map(str, results.aims)}
    printed = (line.rstrip() for line in section.output.splitlines() if not line.startswith(_NOT_THE_TABLE))
    lines = "\n".join(line for line in printed if line.strip() not in known).strip("\n").splitlines()
    if len(lines) > _LONG:
        yield f"<details><summary>The tables, {len(lines)} lines</summary>"
        yield _fenced(lines)
        yield "</details>"
    elif lines:
        yield _fenced(lines)


def _fenced(lines: Sequence[str]) -> str:
    return "\n".join(["```text", *lines, "```"])


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    escaped = (" | ".join(cell.replace("|", _PIPE) for cell in line) for line in (heads, *rows))
    first, *lines = (f"| {line} |".replace("|  |", "| |") for line in escaped)
    return "\n".join((first, "|" + "---|" * len(heads), *lines))


# -- limits


_NO_REAL = (
    "No radio. Every byte went over loopback or a veth pair. Wi-Fi has contention between stations, retries, changing "
    "rates and power save. The profiles of the impaired network imitate the effect of these on bandwidth, delay and "
    "loss, not their cause.",
    "No second machine. Both ends of every latency use the same clock and share the same cores: brokers, operators and "
    "the measuring programs compete with the robot, which they do not on a real robot.",
    "No Raspberry Pi. Its cores are slower, its memory and USB behave differently, and it throttles when hot. Ratios "
    "between variants transfer better than times, and only where both are limited by the same resource.",
    "No camera and no microphone. Pictures and sound are synthetic: a moving scene and speech that are the same in "
    "every run. Real ones are noisier, which costs every encoder bytes, and a real device adds latency.",
    "No hardware encoder. H.264 is x264 on the CPU, as on a robot without one.",
    "No MCU. Its end of the serial line is a simulated board on a pty, which has no baud rate: at 115,200 baud a "
    "command's line of about 15 bytes takes another 1.3 ms, on each transport alike.",
    "No other language. Both ends are Python, with paho and with Zenoh's Python binding; the results include the "
    "interpreter. A C++ node would be faster on either transport, with other ratios.",
    "No large network: no router between hub and peers, no TLS, no other robots on the broker, except in the fleet.",
    "No long run. Each case took seconds to minutes; leaks, and brokers that have run for a month, are not covered.",
)
_OF_QUICK = (
    "A quick run has too few rounds for a narrow 99 % interval, and leaves out most sizes, rates, loads and trials. "
    "“Equal within noise” here mostly means that there was not enough time to measure a difference."
)
_OF_NULL_TESTS = (
    "A null test shows that a comparison finds no difference where there is none. It does not show the cause of the "
    "differences that it finds."
)


def limits(measured: Sequence[Results]) -> list[str]:
    """The limits as sentences, the most important first."""
    return [
        *([_OF_QUICK] if any(one.quick for one in measured) else []),
        _this_machine(measured),
        *_proxy_limits(measured),
        *_NO_REAL,
        _OF_NULL_TESTS,
    ]


def _this_machine(measured: Sequence[Results]) -> str:
    machine = measured[0].machine if measured else {}
    cpu, cores = machine.get("cpu") or "an unknown CPU", machine.get("cores") or "some"
    return (
        f"One machine, {cores} cores of {cpu}. Intervals are over the rounds of one run, so they include the noise of "
        "that hour; another run, another kernel or another load on the same host changes medians by more than they "
        "show. On a virtual machine the host can take CPU time away for milliseconds: the slowest percent shows it."
    )


def _proxy_limits(measured: Sequence[Results]) -> Iterator[str]:
    """How the impaired network was made, if by a proxy."""
    for options in (one.options for one in measured if one.bench == "impair" and one.options.get("link") == "proxy"):
        why = f" ({options['why_proxy']})" if options.get("why_proxy") else ""
        yield (
            f"No namespaces: the impaired network was a TCP proxy{why}. A proxy ends TCP on each side, so loss is "
            "modelled as the delay of TCP's retransmission; no packet is lost or resent on any wire."
        )
