"""The results of a comparison: every sample, and all that is needed to repeat the run."""

from __future__ import annotations

import itertools
import lzma
import math
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import TypeVar

import msgspec

from pebble.errors import PebbleError
from pebble.version import __version__

FORMAT = 1
SAMPLES = "samples.json.xz"  # of the results in the same folder, after a report
LONGEST_S = 3600.0  # of one phase of a comparison
OVER_TIME = " over time"  # suffix of the measure of a cell that holds a curve: times, then values
_MOST = 2000  # samples of a thinned cell
_PERCENTS = (50, 95, 99, 100)  # kept of a thinned cell
_PACKAGES = ("eclipse-zenoh", "paho-mqtt", "numpy", "opencv-python-headless", "av", "msgspec")
_DIGITS = 3  # decimal places of a sample

Value = str | int | float | bool | None
T = TypeVar("T")
K = TypeVar("K", bound=Hashable)


class Cell(msgspec.Struct, kw_only=True):
    """One variant under one set of conditions.

    Cells with equal ``params`` and ``measure`` ran in turn: their rounds with the same number form pairs.
    """

    variant: str
    params: dict[str, Value] = {}
    measure: str  # "one-way", "round trip", …
    unit: str  # of the samples: "us", "ms", "s", "MB", "%"
    rounds: list[list[float]] = []  # the samples of each round, in the order they were taken
    figures: dict[str, Value] = {}  # single values: sent, cpu, …
    counts: list[int] = []  # of a thinned cell: all samples of each round,
    percentiles: dict[str, float] = {}  # and their percentiles

    @property
    def case(self) -> Hashable:
        """What the cells that are compared have in common: conditions and measure."""
        return frozenset(self.params.items()), self.measure

    @property
    def samples(self) -> list[float]:
        return [sample for one in self.rounds for sample in one]

    @property
    def lost(self) -> int | None:
        """Messages that were sent and never arrived; None if not counted."""
        sent = self.figures.get("sent")
        return sent - sum(self.sizes) if isinstance(sent, int) else None

    @property
    def sizes(self) -> list[int]:
        """How many samples each round had, before the cell was thinned."""
        return self.counts or [len(one) for one in self.rounds]

    def single(self, name: str) -> float:
        """One of the ``figures``; NaN without it."""
        found = self.figures.get(name)
        return float(found) if isinstance(found, (int, float)) else math.nan

    def percentile(self, percent: float) -> float:
        """The value over all samples; NaN without samples."""
        known = self.percentiles.get(f"{percent:g}")
        return percentile(self.samples, percent) if known is None else known

    def thinned(self) -> Cell:
        """At most 2,000 samples, or 100 of each round: the last of 100, 200, … equal parts: percentiles stay."""
        most, rounds = max(100, _MOST // max(1, len(self.rounds)) // 100 * 100), []
        for one in self.rounds:
            ordered, parts = one if self.measure.endswith(OVER_TIME) else sorted(one), min(most, len(one))
            rounds.append([ordered[math.ceil(len(one) * part / parts) - 1] for part in range(1, parts + 1)])
        found = {f"{percent}": self.percentile(percent) for percent in _PERCENTS if self.samples}
        return msgspec.structs.replace(self, rounds=rounds, counts=self.sizes, percentiles=found)

    def conditions(self) -> str:
        """The conditions as text: ``40 B, 200 Hz`` or ``640x480, readers: 3``."""
        known = [(name, value) for name, value in self.params.items() if value is not None]
        return ", ".join(value if isinstance(value, str) else f"{name}: {value}" for name, value in known)


class Judged(msgspec.Struct, kw_only=True):
    """An aim: what was to be reached, whether it was (``met``, ``missed`` or ``not judged``), and what was measured."""

    what: str
    outcome: str
    measured: str

    def __str__(self) -> str:
        return f"aim: {self.what}: {self.outcome} ({self.measured})"


class Results(msgspec.Struct, kw_only=True):
    """One run of one comparison."""

    bench: str
    format: int = FORMAT
    pebble: str = __version__
    command: list[str] = []  # repeats the run
    options: dict[str, Value | list[Value]] = {}
    machine: dict[str, Value] = {}
    began: str = ""  # UTC, ISO 8601
    took_s: float = 0.0
    quick: bool = False
    complete: bool = True  # else something could not be measured
    cells: list[Cell] = []
    assessment: list[str] = msgspec.field(name="verdict", default_factory=list)  # sentences
    aims: list[Judged] = []

    def save(self, path: Path) -> None:
        """Raises PebbleError if the file cannot be written."""
        shorter = [[[round(sample, _DIGITS) for sample in one] for one in cell.rounds] for cell in self.cells]
        cells = [msgspec.structs.replace(cell, rounds=one) for cell, one in zip(self.cells, shorter, strict=True)]
        with named(path):
            path.write_bytes(msgspec.json.encode(msgspec.structs.replace(self, cells=cells)) + b"\n")


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Raises PebbleError with the path for an OSError."""
    try:
        yield
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None


def pack(folder: Path) -> None:
    """Moves the samples of all results in a folder into one small file, thinned. Raises PebbleError."""
    found: dict[Path, Results] = {}
    packed: dict[str, list[list[list[int]]]] = {}
    for path in sorted(folder.glob("*.json")):
        with suppress(PebbleError):  # of another version, or not of a comparison
            results = found[path] = load(path)
            cells = [cell if cell.counts else cell.thinned() for cell in results.cells]
            packed[results.bench] = [[_steps(one) for one in cell.rounds] for cell in cells]
            results.cells = [msgspec.structs.replace(cell, rounds=[]) for cell in cells]
    with named(folder / SAMPLES):  # before they are anywhere missing
        (folder / SAMPLES).write_bytes(lzma.compress(msgspec.json.encode(packed), preset=9))
    for path, results in found.items():
        results.save(path)


def _steps(samples: Sequence[float]) -> list[int]:
    """The differences of neighbours, which compress well."""
    whole = [round(sample * 10**_DIGITS) for sample in samples]
    return [one - before for before, one in itertools.pairwise([0, *whole])]


def load(path: Path) -> Results:
    """Reads results, with the samples that a report has moved. Raises PebbleError if the file holds none."""
    try:
        with named(path):
            results = msgspec.json.decode(path.read_bytes(), type=Results)
    except msgspec.DecodeError as error:
        raise PebbleError(f"{path} holds no results of pebble bench: {error}") from None
    if results.format != FORMAT:
        raise PebbleError(f"{path} has format {results.format}, this pebble reads {FORMAT}: measure again")
    if any(cell.counts and not cell.rounds for cell in results.cells):
        _unpack(results, path.with_name(SAMPLES))
    return results


def _unpack(results: Results, path: Path) -> None:
    try:
        packed = msgspec.json.decode(lzma.decompress(path.read_bytes()), type=dict[str, list[list[list[int]]]])
        for cell, rounds in zip(results.cells, packed[results.bench], strict=True):
            cell.rounds = [[value / 10**_DIGITS for value in itertools.accumulate(one)] for one in rounds]
    except (OSError, lzma.LZMAError, msgspec.DecodeError, KeyError, ValueError) as error:
        raise PebbleError(f"{path} does not hold the samples of {results.bench}: {error}") from None


def begin(bench: str, command: Sequence[str], *, quick: bool = False) -> Results:
    """Results of a run that begins now, on this machine."""
    began = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return Results(bench=bench, command=list(command), machine=machine(), began=began, quick=quick)


def machine() -> dict[str, Value]:
    """The machine and the versions the results depend on; no names of hosts or users."""
    from pebble.rig.processes import mosquitto_path  # not for the processes that only measure

    model = re.search(r"^(?:model name|Model).*?: *(.*?) *$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    broker = ""
    if (path := mosquitto_path()) is not None:
        broker = subprocess.run([path, "-h"], capture_output=True, text=True, check=False).stdout.partition("\n")[0]
    return {
        "cpu": model[1] if model else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "system": platform.freedesktop_os_release()["PRETTY_NAME"],
        "python": platform.python_version(),
        "mosquitto": broker.removeprefix("mosquitto version ") or None,
        **{name: one.version for name in _PACKAGES for one in distributions(name=name)},
    }


def grouped(ones: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """By key, in the order of their first appearance."""
    found: dict[K, list[T]] = {}
    for one in ones:
        found.setdefault(key(one), []).append(one)
    return found


def percentile(figures: Sequence[float], percent: float) -> float:
    """The smallest value that at least ``percent`` per cent of the values do not exceed; NaN without values."""
    if not figures:
        return math.nan
    return sorted(figures)[max(0, math.ceil(len(figures) * percent / 100) - 1)]


def rounded(figure: float | int | None, digits: int) -> float | int | None:
    """Rounds for JSON, which has no NaN: None means not measured."""
    return None if figure is None or not math.isfinite(figure) else round(figure, digits)
