"""Durations and sizes as people write them: ``90s``, ``1h``, ``7d``; ``512M``, ``2G``. Pure."""

from __future__ import annotations

import re
from typing import Final

from pebble.errors import PebbleError

_SECONDS: Final = {"": 1, "s": 1, "min": 60, "m": 60, "h": 3600, "d": 86_400}
_BYTES: Final = {"": 1, "k": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
_NUMBER: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)")


def seconds(text: str) -> float:
    """Raises PebbleError."""
    return _value(text, _SECONDS, "a duration: 30s, 10min, 1h or 7d")


def size(text: str) -> int:
    """The size in bytes. Raises PebbleError."""
    return int(_value(text.removesuffix("B"), _BYTES, "a size: 64M, 2G or 1T"))


def _value(text: str, units: dict[str, int], form: str) -> float:
    match = _NUMBER.fullmatch(text.strip())
    unit = units.get(match[2]) if match else None
    if match is None or unit is None:
        raise PebbleError(f'"{text}" is not {form}')
    return float(match[1]) * unit
