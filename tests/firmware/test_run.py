"""The loop on a board: interruption by `pebble flash`, the watchdog, and a robot that fails."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.support import ROOT


class WasReset(BaseException):
    """machine.reset() does not return."""


class Board:
    """Records the calls of the loop, in order."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.ctrl_c_while_waiting = False

    def modules(self) -> dict[str, Any]:
        watchdog = SimpleNamespace(feed=lambda: self.calls.append("feed"))

        def wdt(timeout: int) -> SimpleNamespace:
            self.calls.append("watchdog")
            return watchdog

        def reset() -> None:
            self.calls.append("reset")
            raise WasReset

        def sleep_ms(ms: int) -> None:
            self.calls.append(f"wait {ms}")
            if self.ctrl_c_while_waiting:
                raise KeyboardInterrupt

        return {
            "machine": SimpleNamespace(WDT=wdt, reset=reset),
            "time": SimpleNamespace(sleep_ms=sleep_ms),
            "micropython": SimpleNamespace(kbd_intr=lambda char: self.calls.append(f"ctrl-c {char}"), const=int),
        }


class Robot:
    """Its third step fails, and its stop with it if ``stops`` is False."""

    stops = True

    def __init__(self, board: Board, error: BaseException) -> None:
        self._board, self._error, self._turns = board, error, 0

    def step(self) -> None:
        self._turns += 1
        if self._turns == 3:
            raise self._error

    def stop(self) -> None:
        self._board.calls.append("stop")
        if not self.stops:
            raise self._error


@pytest.fixture
def board() -> Board:
    return Board()


def run(board: Board, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    spec = importlib.util.spec_from_file_location("run_on_a_board", ROOT / "firmware" / "common" / "run.py")
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    with monkeypatch.context() as there:
        for name, stand_in in board.modules().items():
            there.setitem(sys.modules, name, stand_in)
        spec.loader.exec_module(module)
        module.run(lambda _settings: Robot(board, error), {})


@pytest.mark.parametrize(("stops", "end"), [(True, ["feed", "feed", "stop", "reset"]), (False, ["stop", "reset"])])
def test_a_robot_that_fails_stops_and_starts_anew_also_if_it_cannot_stop(
    board: Board, monkeypatch: pytest.MonkeyPatch, stops: bool, end: list[str]
) -> None:
    monkeypatch.setattr(Robot, "stops", stops)
    with pytest.raises(WasReset):
        run(board, monkeypatch, MemoryError("memory allocation failed"))
    assert board.calls[:4] == ["ctrl-c 3", "wait 1000", "ctrl-c -1", "watchdog"]  # Ctrl-C works before it, not after
    assert board.calls[-len(end) :] == end


def test_who_comes_in_by_that_door_finds_no_watchdog(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    board.ctrl_c_while_waiting = True
    with pytest.raises(KeyboardInterrupt):
        run(board, monkeypatch, OSError())
    assert "watchdog" not in board.calls
