"""The same histories in the real MicroPython."""

from __future__ import annotations

import json
from pathlib import Path

from tests.motion.traces import repeat, traces

HISTORIES = 100


def test_micropython_returns_the_same_results(tmp_path: Path) -> None:
    [counts] = repeat(tmp_path, traces(0, HISTORIES))
    histories, calls, same = json.loads(counts)
    assert (histories, same) == (HISTORIES, True)
    assert calls > 50 * HISTORIES
