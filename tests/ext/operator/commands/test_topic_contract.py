"""The contract as ``pebble topic contract`` prints it."""

from __future__ import annotations

import json

import pytest

from pebble.contract import CHANNELS
from pebble.extensions.operator.contract.schemas import schemas
from tests.commands.command_line import GOOB, Run


@pytest.mark.parametrize("columns", [80, 120])
def test_the_contract_as_a_table_spells_every_metric_out(run: Run, columns: int) -> None:
    assert run("topic", "contract", columns=columns) == 0
    words = set(run.out.split())
    assert [channel.metric for channel in CHANNELS if channel.metric not in words] == []
    assert max(map(len, run.out.splitlines())) <= columns


def test_the_contract_for_programs(run: Run) -> None:
    assert run("topic", "contract", "--json", "--base", "goob") == 0
    listed = {entry["topic"]: entry for entry in json.loads(run.out)}
    assert listed.keys() == {f"{GOOB}/{channel.suffix}" for channel in CHANNELS}
    assert listed[f"{GOOB}/outgoing/heartbeat"]["synonym_of"] == "online"
    assert listed[f"{GOOB}/incoming/drive-values"]["retain"] is False
    assert run("topic", "contract", "--json-schema") == 0
    assert json.loads(run.out) == schemas()
