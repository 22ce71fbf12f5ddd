"""The scale curve: a limit of this user is one line, and a short real run has a page server and a hub."""

from __future__ import annotations

import io
import os
import resource
from pathlib import Path

import pytest
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.scale import CPU, HUB, LATENCY, MEMORY, PAGE, Settings, allow_files, run
from pebble.extensions.lab.bench.show import finish
from pebble.extensions.lab.rig.processes import children


def test_a_limit_of_this_user_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = [(100, 1064)]
    monkeypatch.setattr(resource, "getrlimit", lambda _what: allowed[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda _what, limits: allowed.append(limits))
    allow_files(1000)
    assert allowed[-1] == (1064, 1064)
    with pytest.raises(
        PebbleError, match="2000 boards need 2064 open files in one process, and this user may have 1064"
    ):
        allow_files(2000)


@pytest.mark.alone
@pytest.mark.thorough
def test_both_are_measured_with_some_boards(tmp_path: Path) -> None:
    shown = run(Settings(boards=(5, 40), seconds=1.0), Console(file=io.StringIO()))
    assert finish(shown, tmp_path, Console(file=io.StringIO())) == 0
    for variant, others in ((PAGE, ("broker", "boards")), (HUB, ("boards",))):
        for boards in (5, 40):
            latency = shown.results.find(variant, LATENCY, boards=boards)
            assert latency is not None
            assert (len(latency.samples), latency.lost) == (10, 0)
            assert 0 < latency.percentile(50) < 1000
            for process in (variant, *others):
                cpu = shown.results.find(variant, CPU, boards=boards, process=process)
                assert cpu is not None
                assert cpu.samples[0] > 0
            memory = shown.results.find(variant, MEMORY, boards=boards)
            assert memory is not None
            assert memory.samples[0] > 5
    assert children(os.getpid()) == []
