"""When a will is due, in virtual time, without a hub."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from pebble.transports.zenoh.hub.wills import GONE_S, RETURN_S, WillTimes

NEVER = float("inf")

Event = Callable[[WillTimes], object]


def hello(at: float, *, alive: bool = True, has_will: bool = True) -> Event:
    return lambda wills: wills.on_hello("c", at, alive=alive, has_will=has_will)


def gone(at: float) -> Event:
    return lambda wills: wills.on_gone("c", at)


def restart(at: float) -> Event:
    return lambda wills: wills.on_restart(["c"], at)


@pytest.mark.parametrize(
    ("events", "due"),
    [
        pytest.param([hello(0), gone(1)], 1 + GONE_S, id="its token is gone"),
        pytest.param([hello(0), gone(1), lambda wills: wills.forget("c")], NEVER, id="it is back"),
        pytest.param([hello(0), gone(1), hello(1.05)], NEVER, id="it says hello again"),
        pytest.param([hello(0, alive=False)], RETURN_S, id="a hello, and no token"),
        pytest.param([hello(0, alive=False, has_will=False)], NEVER, id="a hello without a will"),
        pytest.param([restart(0)], RETURN_S, id="a restart"),
        pytest.param([gone(0), restart(0.05)], GONE_S, id="a restart while it is due"),
    ],
)
def test_due(events: list[Event], due: float) -> None:
    wills = WillTimes()
    for event in events:
        event(wills)
    assert wills.next_due == pytest.approx(due)
    assert wills.take_due(due - 1e-6) == []
    assert wills.take_due(due) == ([] if due == NEVER else ["c"])
    assert wills.next_due == NEVER
