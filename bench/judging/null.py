"""The null test: does a comparison find a planted difference, and none where there is none? One variant in three roles.

The variant is compared with itself, and with itself slowed by a fifth: the sender takes its time stamp, works for a
fifth of the usual latency, and only then sends.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from pebble.bench.judging.aims import outcome
from pebble.bench.judging.ratios import Interval, paired
from pebble.bench.results import Cell, Judged
from pebble.bench.tables import base_of

_AGAIN, _SLOWED = " again", " +20 %"
SLOWDOWN = 0.2


def roles(variant: str) -> tuple[str, str, str]:
    """Names of the plain, the repeated and the slowed role."""
    return variant, variant + _AGAIN, variant + _SLOWED


def variant_of(role: str) -> str:
    return role.removesuffix(_AGAIN).removesuffix(_SLOWED)


def is_slowed(role: str) -> bool:
    return role.endswith(_SLOWED)


def spin(us: float) -> None:
    """Computes for that many microseconds: sleeping is less exact."""
    end = time.perf_counter_ns() + int(1000 * us)
    while time.perf_counter_ns() < end:
        pass


def intervals(cells: Sequence[Cell]) -> list[tuple[Cell, Interval]]:
    """Each cell of a repeated or slowed role, with the ratio of its median latency to the plain one's."""
    bases = [(cell, base_of(cell, cells, variant_of(cell.variant))) for cell in cells]
    return [(cell, paired(cell.rounds, base.rounds)) for cell, base in bases if base is not None]


def assessment(cells: Sequence[Cell]) -> Iterator[Judged]:
    """The aim: the repeated role is equal and the slowed one slower. Few rounds are not judged."""
    found = intervals(cells)
    passed = [one.low > 1.0 if is_slowed(cell.variant) else one.equal for cell, one in found]
    yield Judged(
        what="no difference found where there is none, and the planted 20 % found",
        outcome=outcome(all(passed), judged=bool(found) and not any(one.few for _, one in found)),
        measured=", ".join(f"{cell.variant} {one}" for cell, one in found),
    )
