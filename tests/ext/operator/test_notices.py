"""The thread for lines."""

import threading

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
