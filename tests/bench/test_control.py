"""Driving a whole robot for a moment, and what is told of it."""

import io
import json
import math
import os
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import control
from pebble.bench.control import LOADED, UNLOADED, Plan, Row, ratios
from pebble.bench.control_operator import wheels
from pebble.bench.usage import children
from pebble.errors import PebbleError


def test_no_two_commands_are_alike_within_hours() -> None:
    assert len({wheels(number) for number in range(100_000)}) == 100_000


def test_every_command_makes_both_wheels_turn_and_none_too_fast() -> None:
    assert all(0.1 <= side < 0.9 for number in range(0, 640_000, 997) for side in wheels(number))


def test_json_has_the_figures_of_a_row() -> None:
    row = Row(kind="zenoh", load=LOADED, latencies_ms=[1.0, 2.0, 30.0], sent=4, cpu=[20.0], flowed={"frames": 29.97})
    assert row.as_json() == {
        "variant": "zenoh",
        "params": {"load": "media"},
        "n": 3,
        "lost": 1,
        "p50_ms": 2.0,
        "p99_ms": 30.0,
        "max_ms": 30.0,
        "cpu": 20.0,
        "frames_per_s": 30.0,
    }


def test_a_row_in_which_nothing_arrived_is_json_too() -> None:
    assert json.dumps(Row(kind="mqtt", load=UNLOADED).as_json(), allow_nan=False)
    assert math.isnan(Row(kind="mqtt", load=UNLOADED).percentile(50))


def test_the_ratio_needs_both_loads() -> None:
    slow, fast = (
        Row(kind="zenoh", load=LOADED, latencies_ms=[3.0]),
        Row(kind="zenoh", load=UNLOADED, latencies_ms=[2.0]),
    )
    assert ratios([fast, slow]) == ["zenoh: p99 with media / without: 1.50"]
    assert ratios([fast]) == []


@pytest.mark.parametrize(
    "plan", [Plan(kinds=["carrier-pigeon"]), Plan(kinds=[]), Plan(seconds=0.0), Plan(rounds=0), Plan(seconds=math.inf)]
)
def test_nonsense_is_refused_before_anything_starts(plan: Plan) -> None:
    with pytest.raises(PebbleError):
        control.run(plan, Console(file=io.StringIO()))


def test_a_whole_robot_is_driven_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(control, "_SETTLE_S", 0.5)
    file, said = tmp_path / "control.json", io.StringIO()
    plan = Plan(seconds=1.0, rounds=1, kinds=["zenoh"], json=file)
    assert control.run(plan, Console(file=said, width=100)) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert (row["variant"], row["params"], row["n"] + row["lost"]) == ("zenoh", {"load": "none"}, 20)
    assert 0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    assert "zenoh" in said.getvalue()
    assert children(os.getpid()) == []
