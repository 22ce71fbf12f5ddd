"""The error of a robot of the trials if one of its processes has ended."""

import sys
from pathlib import Path

import pytest

from pebble.bench.impair.network import REMOTE_HOST, NamespaceNetwork
from pebble.bench.impair.trials import SUBJECTS, ImpairedRobot
from pebble.errors import PebbleError
from pebble.rig.processes import BROKERS, Processes, Program
from pebble.rig.robot import Robot
from tests.support import until

READY = [sys.executable, "-c", "print('{\"ready\": true}', flush=True); input()"]


@pytest.mark.usefixtures("namespaces_permitted")
def test_an_ended_broker_is_named_with_its_log(tmp_path: Path) -> None:
    with Processes() as processes:
        network, operator = processes.add(NamespaceNetwork(), BROKERS), processes.command("operator", READY)
        command = ["sh", "-c", "echo Address already in use >&2; exit 1"]
        broker = processes.add(Program("remote broker", command, tmp_path / "broker.log"), BROKERS)
        robot = Robot(processes, "mqtt", (REMOTE_HOST, 1), folder=tmp_path / "robot")
        assert until(lambda: broker.ended)
        with pytest.raises(PebbleError, match="mqtt original: remote broker has ended\nAddress already in use"):
            ImpairedRobot(SUBJECTS[0], network, robot, broker, operator, limit_s=30).next_report()
