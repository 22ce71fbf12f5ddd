"""What a robot of the trials says when something of it has ended."""

import sys
from pathlib import Path

import pytest

from pebble.bench.frames_process import Worker, end_workers
from pebble.demo.programs import Program
from pebble.errors import PebbleError
from pebble.impair.plan import SUBJECTS
from pebble.impair.robots import Robot
from tests.support import until

READY = [sys.executable, "-c", "print('{\"ready\": true}', flush=True); input()"]


def test_a_broker_that_has_ended_is_named_with_its_last_words(tmp_path: Path) -> None:
    robot = Robot(SUBJECTS[0], "proxy", tmp_path / "robot")
    log = tmp_path / "robot" / "broker.log"
    robot.operator = Worker("operator", READY, tmp_path / "operator.log")
    broker = Program("remote broker of mqtt original", ["sh", "-c", "echo Address already in use >&2; exit 1"], log)
    robot.programs.append(broker)
    try:
        assert until(lambda: broker.ended)
        with pytest.raises(PebbleError, match="remote broker of mqtt original has ended\nAddress already in use"):
            robot.hear(30)
    finally:
        end_workers([robot.operator])
        robot.link.close()
