"""Prints what the firmware costs of each board, and puts it into docs/firmware.md: `make long PART=firmware`."""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.firmware.heap import CASES, LIMITS, Case, Cost, measure
from tests.support import ROOT

DOCS = ROOT / "docs" / "firmware.md"
_HEAD = "| robot | files | names | code loaded | starting | robot made | in use, most | peak | during | limit |"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        costs = pool.map(lambda case: measure(case, Path(folder)), CASES)
        table = heap_table(dict(zip(CASES, costs, strict=True)))
        print(*table, sep="\n")
        _write(table)


def documented() -> dict[str, list[str]]:
    """The cells of the table in docs/firmware.md, by its first column."""
    rows = [line.strip("| ").split(" | ") for line in _table(DOCS.read_text()).splitlines()]
    return {row[0]: row for row in rows}


def _write(table: list[str]) -> None:
    text = DOCS.read_text()
    DOCS.write_text(text.replace(_table(text), "\n".join(table)))


def _table(text: str) -> str:
    start = text.index(_HEAD)
    return text[start : text.index("\n\n", start)]


def heap_table(costs: dict[Case, Cost]) -> list[str]:
    """Bytes of heap, per robot and image."""
    rows = []
    for case, cost in costs.items():
        sizes = (cost.files, cost.names, cost.imported, cost.starting, cost.built, cost.live, cost.peak)
        rows.append(f"| {case} | {' | '.join(map(str, sizes))} | {cost.peak_at} | {LIMITS[case] or ''} |")
    return [_HEAD, "|---|--:|--:|--:|--:|--:|--:|--:|---|--:|", *rows]


if __name__ == "__main__":
    main()
