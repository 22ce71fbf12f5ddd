"""The same histories in the real MicroPython."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pebble.simulation.micropython.loader import firmware_root
from tests.kit.mutations import in_copy
from tests.motion.mutations import MUTATIONS
from tests.motion.traces import repeat, traces
from tests.motion.world import CORE_NAMES
from tests.support import some

HISTORIES, FEW = 300, 100


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


@pytest.mark.parametrize("name", some([name for name, one in MUTATIONS.items() if one.file == "common/lease.py"], 8))
def test_each_deliberate_bug_of_control_shows_there_too(name: str, tmp_path: Path) -> None:
    with in_copy(MUTATIONS[name], firmware_root(), *(f"common/{one}.py" for one in CORE_NAMES)) as root:
        printed = repeat(tmp_path, traces(0, FEW), root)
    assert json.loads(printed[-1])[2] is False
