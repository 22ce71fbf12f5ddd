"""Pictures of results."""

from __future__ import annotations

from pathlib import Path

from pebble.bench.results import Results


def draw(results: Results, folder: Path) -> list[Path]:
    """Draw what this comparison is best seen by; returns the files."""
    del results, folder
    return []
