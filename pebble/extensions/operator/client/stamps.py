"""Time stamps in payloads. Pure."""

from typing import Any

_LATEST_STAMP = 253_402_300_800_000  # the year 10000 in ms: later times are invalid


def stamp_of(plain: Any) -> float | None:
    """Return a JSON payload's stamp in epoch seconds, from ``t`` or ``timestamp``; None if it has none.

    Numbers of 1e11 and more are milliseconds, of 1e9 and more seconds (paper A.4.2).
    """
    if not isinstance(plain, dict):
        return None
    for key in ("t", "timestamp"):
        value = plain.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and value < _LATEST_STAMP:
            if value >= 1e11:
                return value / 1000.0
            if value >= 1e9:
                return float(value)
    return None
