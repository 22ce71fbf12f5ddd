"""How often a board starts again, by its words, its clock and its line."""

from __future__ import annotations

import pytest

from pebble.services.serial_mcu_bridge.line.starts import Starts

#: What happens at each time: "open" the line, "start" what the board says, or what its clock shows; and the count then.
HISTORIES = {
    "one opening": ([(0, "open")], 1, 0),
    "the line comes and goes": ([(0, "open"), (5, "open"), (10, "open")], 11, 2),
    "it says so": ([(0, "open"), (5, "start"), (10, "start"), (15, "start")], 16, 3),
    "one start has several signs": ([(0, "open"), (5, "open"), (6.5, "start"), (6.6, 40)], 7, 1),
    "its clock begins anew": ([(0, "open"), (1, 60_000), (5, 300), (9, 4_300), (12, 10)], 13, 2),
    "its clock wraps": ([(0, "open"), (1, 2**32 - 5), (2, 1_000)], 3, 0),
    "samples overtake one another": ([(0, "open"), (1, 60_000), (2, 59_500)], 3, 0),
    "its clock is that of another opening": ([(0, "open"), (1, 60_000), (5, "open"), (5.1, 10)], 6, 1),
    "long ago": ([(0, "open"), (5, "start"), (30, "start")], 66, 1),
}


@pytest.mark.parametrize(("events", "at", "count"), HISTORIES.values(), ids=HISTORIES)
def test_starts_within_a_minute(events: list[tuple[float, str | int]], at: float, count: int) -> None:
    starts, opened = Starts(), 0
    for now, event in events:
        opened += event == "open"
        does = {"open": lambda _now: None, "start": starts.began}.get(event)
        (does or (lambda now, event=event, opened=opened: starts.sent(opened, event, now)))(now)
        starts.within_a_minute(opened, now)
    assert starts.within_a_minute(opened, at) == count
