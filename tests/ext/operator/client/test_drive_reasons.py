"""The reasons against driving: the same in Python and in the page's JavaScript, by one file of vectors."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import combinations
from typing import Any

import pytest

from pebble.extensions.operator.client import drive_reasons
from pebble.extensions.operator.client.drive_reasons import (
    ORDER,
    SCRIPT_ORDER,
    SERVER_ORDER,
    Code,
    Situation,
    first_reason,
)
from pebble.extensions.page.page_clock import PING_S, PageClock
from tests.ext.page.in_node import evaluate
from tests.support import ROOT

VECTORS = json.loads((ROOT / "tests" / "vectors" / "drive_reasons.json").read_text())
GOOD, WRONG, LIMITS = VECTORS["good"], VECTORS["wrong"], VECTORS["limits"]

#: A page on which nothing is wrong, but for what the vector says.
_PAGE = """
const page = (one) => ({
  name: "goob", words: {}, open: true, drives: true, rights: ["drive"], focus: true, pictureAgeMs: null, failed: "",
  broker: one.problem, liveness: { online: one.online, silent_s: 2 }, estop: { latched: one.latched, by: "eve" },
  freeForMs: 1000 * one.free_s, capabilities: { drive: { available: one.drives, arbitrates: one.arbitrates } },
  driver: one.driven ? { by: "bob" } : { by: "ann", you: true }, script: { running: one.script },
  roundTripMs: 1000 * one.late_s,
});
result = given.map((one) => driveReason(page(one))?.code ?? null);
"""


def page(situations: list[dict[str, Any]]) -> list[str | None]:
    found: list[str | None] = evaluate({"core/reasons.js": "driveReason"}, _PAGE, situations)
    return found


def python(order: tuple[Code, ...]) -> Callable[[list[dict[str, Any]]], list[str | None]]:
    return lambda situations: [first_reason(Situation(**one), order) for one in situations]


DECIDERS = {"page": page, "terminal": python(ORDER), "server": python(SERVER_ORDER), "script": python(SCRIPT_ORDER)}


@pytest.mark.parametrize("who", DECIDERS)
def test_each_reason_counts_and_of_two_the_first(who: str) -> None:
    order = VECTORS["orders"][who]
    pairs = [(one, other) for one, other in combinations(order, 2) if not WRONG[one].keys() & WRONG[other].keys()]
    rows = [({}, None), *((one, None) for one in VECTORS["harmless"])]
    rows += [(WRONG[code], code) for code in order]
    rows += [(WRONG[first] | WRONG[second], first) for first, second in pairs]
    assert DECIDERS[who]([GOOD | change for change, _ in rows]) == [code for _, code in rows]


@pytest.mark.parametrize("who", DECIDERS)
def test_what_is_no_reason_there_changes_nothing(who: str) -> None:
    order = VECTORS["orders"][who]
    apart = [code for code in WRONG if not any(WRONG[code].keys() & WRONG[one].keys() for one in order)]
    assert DECIDERS[who]([GOOD | WRONG[code] for code in apart]) == [None] * len(apart)


def test_the_limits_are_those_of_python_and_of_the_page() -> None:
    assert {name: getattr(drive_reasons, name.upper()) for name in LIMITS} == LIMITS
    exported = evaluate({"core/reasons.js": "SLOW_MS, SLOW_SPEED"}, "result = [SLOW_MS, SLOW_SPEED];")
    assert exported == [1000 * LIMITS["slow_s"], LIMITS["slow_speed"]]


@pytest.mark.parametrize(("round_trip_s", "late"), [(LIMITS["late_s"] - 0.001, False), (LIMITS["late_s"], True)])
def test_a_page_is_late_for_its_server_from_the_same_limit_on(round_trip_s: float, late: bool) -> None:
    clock = PageClock()
    clock.echo(clock.ping(0.0), 0.0, round_trip_s)
    assert bool(clock.problem(round_trip_s + PING_S / 2)) is late
