"""Can this comparison see a difference, and does it see none where there is none? One variant in three roles.

The variant is run against itself, and against itself made a fifth slower: who sends takes its time stamp, then works
for a fifth of the usual latency, and only then sends.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from pebble.bench.ratios import Interval, paired
from pebble.bench.results import Cell

AGAIN, SLOWED = " again", " +20 %"
SLOWDOWN = 0.2


def roles(variant: str) -> tuple[str, str, str]:
    """Names for the variant, for the same once more, and for the slowed one."""
    return variant, variant + AGAIN, variant + SLOWED


def variant_of(role: str) -> str:
    """The variant that plays this role."""
    return role.removesuffix(AGAIN).removesuffix(SLOWED)


def is_slowed(role: str) -> bool:
    return role.endswith(SLOWED)


def spin(us: float) -> None:
    """Work for so many microseconds, as busily as somebody who computes: sleeping is never so exact."""
    end = time.perf_counter_ns() + int(1000 * us)
    while time.perf_counter_ns() < end:
        pass


def intervals(cells: Sequence[Cell]) -> list[tuple[Cell, Interval]]:
    """Each cell of a repeated or slowed role, with its median latency as a ratio to the plain one's."""
    plain = [cell for cell in cells if variant_of(cell.variant) == cell.variant]
    return [
        (cell, paired(cell.rounds, base.rounds))
        for base in plain
        for cell in cells
        if cell is not base and variant_of(cell.variant) == base.variant
        if cell.params == base.params and cell.measure == base.measure
    ]


def verdict(cells: Sequence[Cell]) -> list[str]:
    """A line for each, ``MISSED`` where it was fooled, and the aim. With too few rounds nobody is judged."""
    found = intervals(cells)
    few = any(interval.few for _, interval in found)
    outcome = "not judged" if few else "met" if passed(cells) else "missed"
    told = ", ".join(f"{cell.variant} {interval}" for cell, interval in found)
    lines = [_ratio(cell, interval) if few else _line(cell, interval) for cell, interval in found]
    return [*lines, f"aim: no difference seen where none is, and the planted 20 % seen: {outcome} ({told})"]


def passed(cells: Sequence[Cell]) -> bool:
    """Nothing seen where nothing is, and the slowdown seen; False without cells."""
    found = intervals(cells)
    return bool(found) and all(_as_it_is(cell, interval) for cell, interval in found)


def _as_it_is(cell: Cell, interval: Interval) -> bool:
    return interval.low > 1.0 if is_slowed(cell.variant) else interval.equal


def _line(cell: Cell, interval: Interval) -> str:
    expected = "the planted 20 % were seen" if is_slowed(cell.variant) else "equal, as they are"
    return f"{_ratio(cell, interval)}: {expected if _as_it_is(cell, interval) else 'MISSED'}"


def _ratio(cell: Cell, interval: Interval) -> str:
    return f"{cell.measure}, {cell.conditions()}: {cell.variant} / {variant_of(cell.variant)} = {interval}"
