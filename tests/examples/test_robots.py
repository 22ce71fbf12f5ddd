"""What the samples of a robot owe besides the checks of ``pebble conform``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ext.checks.conform.programs import (
    ROBOT_PY,
    Command,
    Sample,
    mutant,
    robot_in_micropython,
    robot_in_python,
    sketch,
)
from tests.robot.operator import Operator
from tests.support import Broker, Child, until

BASE = "pebble/robots/mine"


def arduino(folder: Path) -> Command:
    """The sketch, on a board whose clock never becomes right."""
    sample = mutant(ROBOT_PY.with_name("robot.cpp"), folder, "1700000000", "99999999999")
    return sketch(sample, folder / "robot")


def micropython(folder: Path) -> Command:
    """The same in MicroPython, where no time server answers."""
    sample = mutant(ROBOT_PY.with_name("robot-micropython.py"), folder, "gmtime()[0] < 2024", "gmtime()[0] < 9999")
    (sample.parent / "ntptime.py").write_text("def settime():\n    raise OSError('no internet')\n")
    return [*robot_in_micropython(folder)[:-1], sample]


@pytest.mark.parametrize("sample", [robot_in_python, arduino, micropython])
def test_topics_of_any_length_hold_up_nothing_nor_does_a_missing_internet(
    sample: Sample, broker: Broker, tmp_path: Path
) -> None:
    operator = Operator(broker.port, BASE)
    robot = Child(list(map(str, [*sample(tmp_path), "mine", "127.0.0.1", broker.port, tmp_path / "stop"])))
    try:
        for state in ("capabilities", "estop/motors"):  # before the first it has subscribed
            operator.wait_for(f"outgoing/{state}", 20)
        for _ in range(50):  # more than a broker sends unacknowledged
            operator.send("incoming/" + 1500 * "x", {})
        for z in (0, 0.5):  # after its start it waits for a zero
            operator.send("incoming/drive-values", {"z": z})
        moves = {"wheels": [0.5, 0.5]}
        assert until(lambda: moves in [status.json["value"] for status in operator.on("outgoing/status")])
    finally:
        robot.kill()
        robot.wait()
        operator.close()
