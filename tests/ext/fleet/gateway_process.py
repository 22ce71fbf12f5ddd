"""`pebble fleet gateway` in a forked process."""

from __future__ import annotations

from pathlib import Path

from pebble.extensions.fleet.commands.gateway import gateway


def main(file: str) -> int:
    return gateway(Path(file))
