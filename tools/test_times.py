"""Shows where the time of a test run went: ``python tools/test_times.py FILE``, the file that tools/run_tests.py wrote.

Seconds are those of a test with its set-up and clean-up, processor time is its own and that of the programs it ended.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

MOST = 10


class Cost(NamedTuple):
    seconds: float
    processor_s: float
    name: str


def costs(path: Path) -> list[Cost]:
    rows = (line.split("\t", 2) for line in path.read_text().splitlines())
    return [Cost(float(seconds), float(processor), name) for seconds, processor, name in rows]


def table(found: list[Cost]) -> str:
    """The slowest tests, and the folders that use most of the processors."""
    slowest = sorted(found, reverse=True)[:MOST]
    folders: defaultdict[str, float] = defaultdict(float)
    for cost in found:
        folders["/".join(cost.name.partition("::")[0].split("/")[:2])] += cost.processor_s
    return "\n".join(
        (
            f"pebble: {len(found)} tests, {sum(c.processor_s for c in found):.0f} s of processor time; the slowest:",
            *(f"  {c.seconds:6.1f} s  {c.name}" for c in slowest),
            "pebble: folders that use the processors most:",
            *(
                f"  {seconds:6.1f} s  {folder}"
                for folder, seconds in sorted(folders.items(), key=lambda one: -one[1])[:MOST]
            ),
        )
    )


if __name__ == "__main__":
    print(table(costs(Path(sys.argv[1]))))
