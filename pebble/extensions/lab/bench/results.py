"""The results of one run of a comparison: every sample, with the options, the machine and the versions."""

from __future__ import annotations

import math
import os
import platform
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import distributions
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from pebble.errors import PebbleError
from pebble.version import __version__

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FLOOR: Final = "C floor"  # programs in C, see floor.c
STAND_IN: Final = "stand-in"  # for the original: plain programs with stock paho, see stand_in.py
_PACKAGES = ("eclipse-zenoh", "paho-mqtt", "numpy", "opencv-python-headless", "av", "msgspec")
_DIGITS = 3  # decimal places of a sample

Value = str | int | float | bool | None
Params = Mapping[str, Value]
T = TypeVar("T")
K = TypeVar("K", bound=Hashable)


class Cell(msgspec.Struct, kw_only=True):
    """The samples of one variant under one set of conditions.

    Cells with equal ``params`` and ``measure`` ran in turn: their rounds with the same number form pairs.
    """

    variant: str
    params: dict[str, Value] = {}
    measure: str  # "one-way", "down", …
    unit: str  # of the samples: "us", "ms", "s", "MB", "%"
    rounds: list[list[float]] = []  # the samples of each round, in the order they were taken
    figures: dict[str, list[float]] = {}  # what each round counted or read besides: sent, late, …

    @property
    def samples(self) -> list[float]:
        return [sample for samples in self.rounds for sample in samples]

    @property
    def lost(self) -> int | None:
        """Number of messages that were sent and never arrived; None if they are not counted."""
        return self.total("sent") - len(self.samples) if "sent" in self.figures else None

    def total(self, name: str) -> int:
        return round(sum(self.figures.get(name, ())))

    def middle(self, name: str) -> float:
        """Return the median of a figure over the rounds; NaN if there is none."""
        return median(self.figures.get(name) or [math.nan])

    def percentile(self, percent: float) -> float:
        return percentile(self.samples, percent)

    def medians(self) -> list[float]:
        """Return the median of each round that has samples."""
        return [percentile(samples, 50) for samples in self.rounds if samples]

    def with_lost(self) -> list[list[float]]:
        """Return the rounds with lost messages included as infinitely late."""
        if self.lost is None:
            return self.rounds
        return [
            [*samples, *[math.inf] * (round(sent) - len(samples))]
            for samples, sent in zip(self.rounds, self.figures["sent"], strict=True)
        ]

    def conditions(self) -> str:
        """Return the conditions as text: ``40 B, 200 Hz`` or ``640x480, readers: 3``."""
        return ", ".join(value if isinstance(value, str) else f"{name}: {value}" for name, value in self.params.items())


def round_cell(
    variant: str, measure: str, unit: str, samples: Iterable[float], params: Params | None = None, **figures: float
) -> Cell:
    """Return a cell with the samples of one round."""
    return Cell(
        variant=variant, measure=measure, unit=unit, rounds=[list(samples)], params=dict(params or {}),
        figures={name: [value] for name, value in figures.items()},
    )  # fmt: skip


class Results(msgspec.Struct, kw_only=True):
    """A run of a comparison."""

    bench: str
    pebble: str = __version__
    options: dict[str, object] = {}
    machine: dict[str, Value] = {}
    began: str = ""  # UTC, ISO 8601
    took_s: float = 0.0
    quick: bool = False
    complete: bool = True  # else something could not be measured
    notes: list[str] = []  # what was left out, and why
    cells: list[Cell] = []

    def save(self, path: Path) -> None:
        """Write the file. Raises PebbleError if it cannot be written."""
        cells = []
        for cell in self.cells:
            rounds = [[round(sample, _DIGITS) for sample in samples] for samples in cell.rounds]
            cells.append(msgspec.structs.replace(cell, rounds=rounds))
        with naming_in_errors(path):
            path.write_bytes(msgspec.json.encode(msgspec.structs.replace(self, cells=cells)) + b"\n")

    def find(self, variant: str, measure: str, **params: Value) -> Cell | None:
        """Return the first cell whose ``params`` include these; None if there is none."""
        for cell in self.cells:
            if (cell.variant, cell.measure) == (variant, measure) and params.items() <= cell.params.items():
                return cell
        return None


def load(path: Path) -> Results:
    """Read results. Raises PebbleError if the file holds none."""
    try:
        with naming_in_errors(path):
            return msgspec.json.decode(path.read_bytes(), type=Results)
    except msgspec.DecodeError as error:
        raise PebbleError(f"{path} holds no results of pebble bench: {error}") from None


def begin(bench: str, settings: DataclassInstance) -> Results:
    """Return empty results for a run that begins now on this machine."""
    began = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return Results(bench=bench, options=asdict(settings), machine=machine(), began=began)


@contextmanager
def naming_in_errors(path: Path) -> Iterator[None]:
    """Raise PebbleError that names the path, in place of an OSError of the ``with`` block."""
    try:
        yield
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None


def check_folder(folder: Path) -> None:
    """Raise PebbleError if the folder cannot be written: before an hour of measuring, not after it."""
    with naming_in_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


def machine() -> dict[str, Value]:
    """Return the properties of the machine, and the versions, that matter; no names of hosts or users."""
    from pebble.extensions.operator.places import mosquitto_path  # not for the processes that only measure

    model = re.search(r"^(?:model name|Model).*?: *(.*?) *$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    broker_version = ""
    if (path := mosquitto_path()) is not None:
        help_text = subprocess.run([path, "-h"], capture_output=True, text=True, check=False).stdout
        broker_version = help_text.partition("\n")[0].removeprefix("mosquitto version ")
    return {
        "cpu": model[1] if model else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "system": platform.freedesktop_os_release()["PRETTY_NAME"],
        "python": platform.python_version(),
        "mosquitto": broker_version or None,
        **{name: package.version for name in _PACKAGES for package in distributions(name=name)},
    }


def grouped(things: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Return the things by their key, in the order in which keys first appear."""
    groups: dict[K, list[T]] = {}
    for thing in things:
        groups.setdefault(key(thing), []).append(thing)
    return groups


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the smallest value that at least ``percent`` per cent of the values do not exceed; NaN without values."""
    if not values:
        return math.nan
    count = math.ceil(len(values) * percent / 100)  # of the values up to the percentile
    return sorted(values)[max(0, count - 1)]
