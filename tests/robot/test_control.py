"""Who drives a whole robot: control given, taken and lost, seen from outside on both transports."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.robot.operator import Operator, driving
from tests.robot.rig import BASE, Rig, lines
from tests.support import beside, cases, until

pytestmark = pytest.mark.alone  # lines are counted

CONTROL, DRIVE, STATE = "incoming/control", "incoming/drive-values", "outgoing/control/serial"
OTTO = {"id": "aaaaaaaa", "by": "otto", "for_ms": 10_000}
#: The short row runs beside other tests. The least share of commands that become lines, and the longest gap, seconds.
FLOOD_S, LEAST, GAP_S = float(cases(3, 60)), cases(80, 95) / 100, cases(200, 25) / 100


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param) as one:
        yield one


def state(rig: Rig) -> dict[str, Any]:
    last = rig.operator.last(STATE)
    return last.json if last is not None else {}


def held(rig: Rig, topic: str, client: dict[str, Any]) -> str:
    """Its key, once this client has control."""
    rig.operator.send(topic, client)
    assert until(lambda: state(rig).get("id") == client["id"], 5), state(rig)
    key: str = state(rig)["key"]
    return key


def test_a_flood_of_strangers_takes_nothing_from_who_has_control(rig: Rig) -> None:
    key = held(rig, CONTROL, OTTO)
    numbers, ending = itertools.count(), threading.Event()
    stranger = Operator(rig.remote.port, BASE, STATE)

    def flood() -> None:
        """A thousand messages a second: commands with wrong keys, requests under new ids, releases."""
        while not ending.wait(0.02):
            for number in itertools.islice(numbers, 20):
                name = {"id": f"{number:08x}", "by": "mia"}
                body = ({"x": 0, "z": -0.9, "key": f"{number:08x}"}, name, name | {"want": "release"})[number % 3]
                stranger.send(DRIVE if number % 3 == 0 else CONTROL, body)

    try:
        with driving(rig.operator, 0.5, key=key) as driver:
            assert until(lambda: lines(rig, 0.5), 5)
            with beside(flood, ending):
                began, before = time.monotonic(), len(driver.sent_at)
                assert until(lambda: time.monotonic() > began + FLOOD_S, FLOOD_S + 5)
                asked = len(driver.sent_at) - before
            assert until(lambda: len(lines(rig, 0.5, began)) >= LEAST * asked, 2), (len(lines(rig, 0.5, began)), asked)
        assert max(after - line for line, after in itertools.pairwise(lines(rig, 0.5, began))) <= GAP_S
        assert next(numbers) > 300 * FLOOD_S
        assert lines(rig, -0.9) == []
        assert state(rig)["id"] == OTTO["id"]
    finally:
        stranger.close()
