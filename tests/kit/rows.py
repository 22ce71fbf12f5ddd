"""The choice of rows for ``make test``: some of each long table; ``make test THOROUGH=1`` runs them all.

Each line of ``rows.txt`` is a test whose rows are one rule for several transports, encodings, kinds of damage or ways
to fail, with the number of rows that stay. A remaining row fails when the rule itself breaks; a row left out fails when
it breaks for one member. Rows of other tests cost little, or each is a rule of its own.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from zlib import crc32

import pytest


def table() -> dict[str, int]:
    """Return the number of rows that stay, by file below ``tests/`` and test."""
    rows, file = {}, ""
    for line in Path(__file__).with_suffix(".txt").read_text().splitlines():
        if line.startswith(" "):
            number, test = line.split()
            rows[f"{file}::{test}"] = int(number)
        else:
            file = line
    return rows


def fewer(items: Iterable[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield the collected rows that only ``make test THOROUGH=1`` runs."""
    groups: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        if item.get_closest_marker("thorough") is None:
            groups[item.nodeid.partition("[")[0].removeprefix("tests/")].append(item)
    for test, due in table().items():
        rows = groups[test]
        first = crc32(test.encode())  # so that the tests of a file do not all keep its first transport
        stay = {(first + number * len(rows) // due) % len(rows) for number in range(min(due, len(rows)))}
        yield from (row for at, row in enumerate(rows) if at not in stay)
