"""How long a seek in a recording of one hour takes, without a page: ``python -m tests.recordings.seek.speed``."""

from __future__ import annotations

import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pebble.bench.results import percentile
from pebble.bench.usage import pss_mb
from pebble.recordings.seek.archive import Archive
from pebble.recordings.seek.segment import segment
from tests.recordings.playing import GOOB, ms
from tests.recordings.seek.filming import film

SECONDS, SEEKS = 3600, 300
SIZE = (640, 480)


def timed(ask: Callable[[float], object], chance: random.Random) -> list[float]:
    """Milliseconds of each of many random seeks."""
    found = []
    for _ in range(SEEKS):
        at, began = chance.uniform(5, SECONDS), time.perf_counter()
        ask(ms(at))
        found.append(1000 * (time.perf_counter() - began))
    return found


def main() -> None:
    chance = random.Random(1)
    for encoding in ("json", "pbvd", "pbvz", "h264"):
        with tempfile.TemporaryDirectory() as folder:
            root = film(Path(folder), encoding, SECONDS, SIZE, times=60, interval=None)
            size = sum(path.stat().st_size for path in root.rglob("*.mcap")) / 1e6
            archive, began = Archive(root), time.perf_counter()
            segment(archive, GOOB, ms(1), 2000, seek=True, media=True)
            opened = 1000 * (time.perf_counter() - began)
            before = pss_mb(os.getpid())
            took = timed(lambda at, one=archive: segment(one, GOOB, at, 2000, seek=True, media=True), chance)
            sys.stdout.write(
                f"{encoding}, {size:.0f} MB: p50 {percentile(took, 50):.1f} p95 {percentile(took, 95):.1f} "
                f"max {max(took):.1f} ms; first {opened:.0f} ms\n"
            )
            sys.stdout.write(f"{encoding}: {before:.0f} MB before {SEEKS} seeks, {pss_mb(os.getpid()):.0f} MB after\n")
            archive.close()


if __name__ == "__main__":
    main()
