"""The thread for lines."""

import threading

import pytest

from pebble.extensions.operator import notices
from pebble.extensions.operator.notices import PrintingThread


def test_lines_are_printed_in_turn_also_after_an_error_and_hold_up_nothing() -> None:
    printing, printed, goes_on = PrintingThread(), list[str](), threading.Event()
    for prints in (goes_on.wait, lambda: printed[0], lambda: printed.append("a"), lambda: printed.append("b")):
        printing.run(prints)
    printing.close(0.01)
    assert not printed
    goes_on.set()
    printing.close()
    assert printed == ["a", "b"]


def test_lines_are_bounded_and_what_was_dropped_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(notices, "_MOST", 2)
    printing, printed, goes_on = PrintingThread(), list[int](), threading.Event()
    printing.run(goes_on.wait)
    for number in range(9):
        printing.run(lambda number=number: printed.append(number))
    goes_on.set()
    printing.close()
    assert printed == list(range(len(printed)))
    assert capsys.readouterr().err == f"pebble: lines that were not printed, as too many waited: {9 - len(printed)}\n"
