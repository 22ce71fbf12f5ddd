"""Runs the comparisons of a report, each by its command, and writes the report: README.md and its charts."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.results import STAND_IN, Results, Value, check_folder, load, naming_in_errors
from pebble.extensions.lab.bench.show import RATIOS, compared, middle
from pebble.extensions.lab.rig.processes import Program, end_all, python
from pebble.extensions.operator.signals import interrupted_by_signals

NAME: Final = "README.md"
_HEADING = "# Results"  # the first line of every report
#: Before a command: its tables are plain text of this width.
_PLAIN = ("env", "-u", "FORCE_COLOR", "-u", "TTY_COMPATIBLE", "COLUMNS=120", "NO_COLOR=1", "PYTHONUNBUFFERED=1")
_POLL_S = 0.2
_TIMEOUT_FACTOR, _TIMEOUT_EXTRA_S = 4, 60.0  # of the expected time: a comparison that takes longer is ended
_END_S = 20.0  # for a comparison to end its processes


@dataclass(frozen=True, slots=True)
class Section:
    """A comparison of the report, with the seconds that it takes in full and in a quick run."""

    name: str
    title: str
    full_s: int
    quick_s: int
    needs_root: bool = False

    def expected_s(self, quick: bool) -> int:
        return self.quick_s if quick else self.full_s

    def command(self, quick: bool) -> list[str]:
        return ["bench", self.name, *(["--quick"] if quick else [])]


SECTIONS: Final = (
    Section("control", "Service to service", 250, 25),
    Section("bridge", "Operator to wheels, and back", 2200, 30),
    Section("startup", "Start-up", 240, 60),
    Section("cost", "Memory and CPU", 180, 20),
    Section("frames", "Camera frames inside the robot", 240, 15),
    Section("scale", "Many boards", 150, 25),
    Section("traffic", "Traffic of robots, as in the paper", 140, 19),
    Section("impair", "On an impaired network", 900, 150, needs_root=True),
)


@dataclass(frozen=True, slots=True)
class Headline:
    """A row of the first table: a measure of a comparison, and the variant for each of the three columns."""

    what: str
    bench: str
    measure: str
    params: Mapping[str, Value] = field(default_factory=dict)
    variants: Sequence[str] = (STAND_IN, "mqtt", "zenoh")


_MESSAGES: Final = {"size": "40 B", "rate": "200 Hz"}  # the condition of `control` that stands in the table
_P2P: Final = (STAND_IN, "mqtt", "zenoh-p2p")
HEADLINES: Final = (
    Headline("message between two services", "control", "one-way", {**_MESSAGES, "load": "none"}, _P2P),
    Headline("the same, beside pictures", "control", "one-way", {**_MESSAGES, "load": "media"}, _P2P),
    Headline("command to the wheels, commands only", "bridge", "down", {"load": "commands"}),
    Headline("the same, with reports", "bridge", "down", {"load": "none"}),
    Headline("report to the operator", "bridge", "up", {"load": "none"}),
    Headline("CPU of the bridge per message", "bridge", "CPU per message", {"load": "none", "process": "bridge"}),
    Headline("launch to ready", "startup", "all ready"),
    Headline("launch to the first drive command obeyed", "startup", "first drive obeyed"),
    Headline("memory of a robot at rest", "cost", "PSS", {"phase": "idle", "process": "all"}),
    Headline("CPU of a driven robot", "cost", "CPU", {"phase": "driving", "process": "all"}),
    Headline("frame of 640x480 to one reader; the original's GStreamer", "frames", "frame",
             {"size": "640x480", "readers": 1}, ("gstreamer-shm", "mqtt", "zenoh-shm")),
    Headline("frame of 1920x1080 to one reader; the original's GStreamer", "frames", "frame",
             {"size": "1920x1080", "readers": 1}, ("gstreamer-shm", "mqtt", "zenoh-shm")),
    Headline("sound within 1 s at 64 kbit/s and 5 % loss; the original's encodings", "impair", "audio within 1 s",
             {"trial": "64k+5%"}, ("mqtt original", "mqtt h264 opus", "zenoh h264 opus")),
)  # fmt: skip


def run(names: Sequence[str], folder: Path, *, quick: bool, console: Console) -> int:
    """Measure and write a report; return 0 if every comparison succeeded. If one fails, the others still run.

    Without names it runs all that this user may run. Raises PebbleError if the folder cannot be written.
    """
    path, sections, failed = _report_path(folder), _chosen(names), 0
    console.print(f"{len(sections)} comparisons: about {_span(sum(section.expected_s(quick) for section in sections))}")
    try:
        with interrupted_by_signals():
            for section in sections:
                began = time.monotonic()
                with console.status(f"{section.name}, about {section.expected_s(quick)} s"):
                    problem = run_one(section, folder, quick)
                line = f"{section.name} {problem}: see {folder / section.name}.txt" if problem else section.name
                console.print(f"{line}, {_span(time.monotonic() - began)}", soft_wrap=True)
                failed += bool(problem)
    finally:  # also after Ctrl-C
        with naming_in_errors(path):
            path.write_text(text(folder))
        console.print(f"Written: {path}", soft_wrap=True)
    return 1 if failed else 0


def _report_path(folder: Path) -> Path:
    """Return the report's path. Raises PebbleError now, not after an hour, if it cannot or must not be written."""
    if find_spec("matplotlib") is None:
        raise PebbleError("a report needs matplotlib, which is not installed: pip install 'pebble-robot[bench]'")
    check_folder(folder)
    path = folder / NAME
    if path.exists() and not path.read_text(errors="replace").startswith(_HEADING):
        raise PebbleError(f"{path} is not a report of pebble bench and would be overwritten: name another folder")
    return path


def _chosen(names: Sequence[str]) -> list[Section]:
    """Return the sections of these names; without names all that this user may run."""
    if names:
        return [section for section in SECTIONS if section.name in names]
    return [section for section in SECTIONS if not (section.needs_root and os.geteuid())]


def run_one(section: Section, folder: Path, quick: bool) -> str:
    """Run a comparison's command; return why it failed, or "". The command ends with this process."""
    results, output = (folder / f"{section.name}.{ending}" for ending in ("json", "txt"))
    for path in (results, output, *folder.glob(f"{section.name}*.png")):  # of an earlier run: they would hide a failure
        path.unlink(missing_ok=True)
    words = python("pebble.cli", *section.command(quick), "--output", folder)
    until = time.monotonic() + _TIMEOUT_FACTOR * section.expected_s(quick) + _TIMEOUT_EXTRA_S
    program = Program(section.name, [*_PLAIN, *words], output)
    try:
        while (code := program.code) is None and time.monotonic() < until:
            time.sleep(_POLL_S)
    finally:
        end_all([program], _END_S)
    if code is None:
        return "hung and was ended"
    if code:
        return f"ended with code {code}"
    return "" if results.exists() else "measured nothing"


def _span(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 600 else f"{seconds:.0f} s"


# -- the page


def text(folder: Path) -> str:
    """Return the Markdown report of the results in ``folder``: a summary table, then the output of each command."""
    measured = dict[str, Results]()
    for section in SECTIONS:
        with suppress(PebbleError):  # it failed, or was not measured
            measured[section.name] = load(folder / f"{section.name}.json")
    quick = any(results.quick for results in measured.values())
    parts = [f"{_HEADING} of a quick run" if quick else _HEADING, *_headlines(measured)]
    for section in SECTIONS:
        if (output := folder / f"{section.name}.txt").exists():
            parts += [f"## {section.title}", *_about(section, measured.get(section.name))]
            parts += [f"![{path.stem}]({path.name})" for path in sorted(folder.glob(f"{section.name}*.png"))]
            parts.append("\n".join(["```text", output.read_text(errors="replace").rstrip(), "```"]))
    return "\n\n".join(parts) + "\n"


def _about(section: Section, results: Results | None) -> Iterator[str]:
    """Yield paragraphs that tell how the section was measured; ``results``: None if it left no file."""
    if results is None:
        yield "**It failed, and left no results.**"
        return
    yield f"    pebble {' '.join(section.command(results.quick))}"
    incomplete = "" if results.complete else " **Something could not be measured.**"
    machine = ", ".join(f"{name} {value}" for name, value in results.machine.items() if value)
    yield f"Started {results.began}, {_span(results.took_s)}, by pebble {results.pebble}; {machine}.{incomplete}"


def _headlines(measured: Mapping[str, Results]) -> Iterator[str]:
    """Yield the rows that compare MQTT with Zenoh, and the stand-in of the original beside them."""
    rows = []
    for headline in HEADLINES:
        results = measured.get(headline.bench)
        if results is None:
            continue
        cells = [results.find(variant, headline.measure, **headline.params) for variant in headline.variants]
        if not any(cells):
            continue
        _, mqtt, zenoh = cells
        unit = next(cell.unit for cell in cells if cell).replace("us", "µs")
        rows.append((headline.what, unit, *map(middle, cells), compared(zenoh, mqtt)))
    if rows:
        heads = ("median", "unit", STAND_IN, "mqtt", "zenoh", "zenoh / mqtt")
        yield "\n".join(f"| {' | '.join(line)} |" for line in (heads, ["---"] * len(heads), *rows))
        yield f"The {STAND_IN} is plain paho in place of the original, or as the row says. {RATIOS}"
