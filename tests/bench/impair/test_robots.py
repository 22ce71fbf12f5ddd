"""The error of a robot of the trials if one of its processes has ended."""

import sys
from pathlib import Path

import pytest

from pebble.bench.impair.plan import SUBJECTS
from pebble.bench.impair.robots import ImpairedRobot
from pebble.bench.worker import Worker, end_workers
from pebble.errors import PebbleError
from pebble.rig.programs import Program
from tests.support import until

READY = [sys.executable, "-c", "print('{\"ready\": true}', flush=True); input()"]


def test_an_ended_broker_is_named_with_its_log(tmp_path: Path) -> None:
    robot = ImpairedRobot(SUBJECTS[0], "proxy", tmp_path / "robot")
    log = tmp_path / "robot" / "broker.log"
    robot.operator = Worker("operator", READY, tmp_path / "operator.log")
    broker = Program("remote broker of mqtt original", ["sh", "-c", "echo Address already in use >&2; exit 1"], log)
    robot.programs.append(broker)
    try:
        assert until(lambda: broker.ended)
        with pytest.raises(PebbleError, match="remote broker of mqtt original has ended\nAddress already in use"):
            robot.next_report(30)
    finally:
        end_workers([robot.operator])
        robot.network.close()
