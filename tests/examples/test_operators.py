"""What the samples of an operator do when their person leaves."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from tests.ext.checks.conform.programs import OPERATORS, Sample, robot_in_python
from tests.robot.operator import Operator
from tests.support import Broker, Child, until

DRIVE, CONTROL = "incoming/drive-values", "incoming/control"
ASKS_S = 1.0


@pytest.mark.parametrize("sample", OPERATORS)
def test_who_leaves_sends_a_zero_and_asks_no_more(sample: Sample, broker: Broker, tmp_path: Path) -> None:
    at = ["mine", "127.0.0.1", str(broker.port)]
    watching = Operator(broker.port, "pebble/robots/mine")
    robot = Child(list(map(str, [*robot_in_python(tmp_path), *at, tmp_path / "stop"])))
    person = Child(list(map(str, [*sample(tmp_path), *at])), stdin=subprocess.PIPE, text=True)
    try:
        watching.wait_for("outgoing/online", 20)
        assert until(lambda: pushes(person) and newest(watching, DRIVE).get("z") == 0.5, 20, step=0.5)
        asked = watching.wait_for(CONTROL, since=time.monotonic())
        until(lambda: time.monotonic() > asked.at + 0.8 * ASKS_S)  # it is about to ask again
        person.communicate()
        assert until(lambda: newest(watching, CONTROL)["want"] == "release")
        assert newest(watching, DRIVE)["z"] == 0
    finally:
        for program in (person, robot):
            program.kill()
            program.wait()
        watching.close()


def pushes(person: Child) -> bool:
    """Let go of the stick, and push it."""
    assert person.stdin is not None
    person.stdin.write("0 0\n0 0.5\n")
    person.stdin.flush()
    return True


def newest(watching: Operator, suffix: str) -> dict[str, Any]:
    message = watching.last(suffix)
    return {} if message is None else dict(message.json)
