"""What the page shows of gateways."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.web.gateways import MOST, Gateways

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


def heartbeat(*robots: str) -> bytes:
    return json.dumps({"t": 1, "run": "r", "number": 1, "robots": robots}).encode()


BOTH = heartbeat(GOOB, FRED)
#: Heartbeats, by gateway, and what the last one changes where both robots are known.
CHANGES: dict[str, tuple[list[tuple[str, bytes]], dict[str, Any]]] = {
    "the first": ([("a", BOTH)], {GOOB: ("a",), FRED: ("a",)}),
    "the same again": ([("a", BOTH), ("a", BOTH)], {}),
    "a second gateway": ([("b", BOTH), ("a", heartbeat(GOOB))], {GOOB: ("a", "b")}),
    "it receives one no more": ([("a", BOTH), ("a", heartbeat(GOOB))], {FRED: ()}),
    "its will": ([("a", BOTH), ("b", heartbeat(FRED)), ("a", b"")], {GOOB: (), FRED: ("b",)}),
    "no heartbeat": ([("a", heartbeat(GOOB)), ("a", b"{")], {GOOB: ()}),
    "one that is not known": ([("a", heartbeat("pebble/robots/x"))], {}),
    "too many gateways": ([*((f"g{n}", heartbeat("x")) for n in range(MOST)), ("a", BOTH)], {}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_only_what_changes_is_shown(change: str) -> None:
    gateways, (heartbeats, wanted) = Gateways(), CHANGES[change]
    assert [gateways.receive(*one, {GOOB, FRED}) for one in heartbeats][-1] == wanted


def test_what_becomes_known_later_is_shown_then() -> None:
    gateways = Gateways()
    assert gateways.receive("a", BOTH, set()) == {}
    assert gateways.receive("a", BOTH, {GOOB}) == {GOOB: ("a",)}
