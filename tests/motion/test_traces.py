"""The same histories in the real MicroPython."""

from __future__ import annotations

import json
from pathlib import Path

from tests.motion.traces import repeat, traces

HISTORIES = 300


def test_micropython_returns_the_same_results(tmp_path: Path) -> None:
    [counts] = repeat(tmp_path, traces(0, HISTORIES))
    histories, calls, same = json.loads(counts)
    assert (histories, same) == (HISTORIES, True)
    assert calls > 50 * HISTORIES


def test_a_different_result_is_found(tmp_path: Path) -> None:
    wrong = [
        [0, "latch", ["00c0ffee", 4], None],
        [0, "lease", [0, 1, 0], None],
        [0, "arbiter", [0, 750], None],
        [0, "tick", [0], 7],
    ]
    printed = repeat(tmp_path, [json.dumps(wrong)])
    assert printed == ["differs: tick [0] 7 0", "[1, 4, false]"]
