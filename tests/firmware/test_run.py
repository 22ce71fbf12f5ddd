"""The loop on a board: interruption by `pebble flash`, the watchdog, and a robot that fails."""

from __future__ import annotations

import runpy
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support import ROOT


class WasReset(BaseException):
    """machine.reset() does not return."""


class Robot:
    """A robot whose third step fails, and its stop with it unless it ``stops``."""

    def __init__(self, calls: list[str], *, stops: bool) -> None:
        self.calls, self.stops, self.turns = calls, stops, 0

    def step(self) -> None:
        self.turns += 1
        if self.turns == 3:
            raise MemoryError("memory allocation failed")

    def stop(self) -> None:
        self.calls.append("stop")
        if not self.stops:
            raise MemoryError("memory allocation failed")


def run(monkeypatch: pytest.MonkeyPatch, calls: list[str], *, stops: bool = True, ctrl_c: bool = False) -> None:
    """Run the loop; ``calls`` is what it calls, in order. ``ctrl_c``: pressed while it waits for that."""

    def note(call: str, error: type[BaseException] | None = None, result: Any = None) -> Any:
        calls.append(call)
        if error:
            raise error
        return result

    watchdog = SimpleNamespace(feed=lambda: note("feed"))
    machine = SimpleNamespace(
        WDT=lambda timeout: note("watchdog", None, watchdog), reset=lambda: note("reset", WasReset)
    )
    time = SimpleNamespace(sleep_ms=lambda ms: note(f"wait {ms}", KeyboardInterrupt if ctrl_c else None))
    micropython = SimpleNamespace(kbd_intr=lambda char: note(f"ctrl-c {char}"), const=int)
    with monkeypatch.context() as there:
        for name, stand_in in (("machine", machine), ("time", time), ("micropython", micropython)):
            there.setitem(sys.modules, name, stand_in)
        loop = runpy.run_path(str(ROOT / "firmware" / "common" / "run.py"))
        loop["run"](lambda _settings: Robot(calls, stops=stops), {})


@pytest.mark.parametrize("stops", [True, False])
def test_a_robot_that_fails_stops_and_starts_anew_also_if_it_cannot_stop(
    monkeypatch: pytest.MonkeyPatch, stops: bool
) -> None:
    calls: list[str] = []
    with pytest.raises(WasReset):
        run(monkeypatch, calls, stops=stops)
    assert calls[:4] == ["ctrl-c 3", "wait 1000", "ctrl-c -1", "watchdog"]  # Ctrl-C works before it, not after
    assert calls[4:] == ["feed", "feed", "stop", "reset"]


def test_who_comes_in_by_that_door_finds_no_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        run(monkeypatch, calls, ctrl_c=True)
    assert "watchdog" not in calls
