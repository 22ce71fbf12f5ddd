"""A robot and the second one made of its backup, at one broker: both drive at once, and each stops alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.contract.identity import Identity
from pebble.fleet.roles import Account
from pebble.setup.places import Places
from tests.commands.command_line import Run
from tests.fleet.brokers import HOST, FleetBroker
from tests.robot.operator import Operator
from tests.robot.rig import Mcu
from tests.setup.rig import ANSWERS, backup_of, machine_root
from tests.support import ROOT, Child, free_port, until

pytestmark = pytest.mark.alone  # whole robots

ROBOTS = ("goob", "fred")
BASES = {name: str(Identity("pebble", "robots", name)) for name in ROBOTS}


def test_a_robot_and_the_second_one_of_its_backup_drive_at_once_and_each_stops_alone(tmp_path: Path, run: Run) -> None:
    accounts = {name: Account(roles=("robot",), bases=(base,)) for name, base in BASES.items()}
    accounts["ann"] = Account(roles=("driver", "safety"))
    with ExitStack() as running:
        broker = running.enter_context(FleetBroker(tmp_path / "hall", accounts, unencrypted=free_port()))
        boards: dict[str, Mcu] = {}
        passwords: dict[str, Path] = {}
        for name in ROBOTS:
            (tmp_path / name).mkdir()
            boards[name] = Mcu(tmp_path / name)
            running.callback(boards[name].close)
            passwords[name] = tmp_path / f"{name}.password"
            passwords[name].write_text(broker.passwords[name])
        answers = ANSWERS | {"port": str(boards["goob"].port), "camera": "none", "page": False}
        answers |= {"broker": f"{HOST}:{broker.unencrypted}", "broker_user": "goob"}
        (tmp_path / "answers.json").write_text(json.dumps(answers | {"broker_password_file": str(passwords["goob"])}))
        roots = {name: machine_root(tmp_path / f"machine of {name}") for name in ROBOTS}
        assert run("setup", "--root", roots["goob"], "--answers", tmp_path / "answers.json", "--yes") == 0
        backup = backup_of(roots["goob"], tmp_path / "goob.tar")
        own = ("--port", boards["fred"].port, "--broker-user", "fred", "--broker-password-file", passwords["fred"])
        assert run("setup", "--root", roots["fred"], "--from", backup, "--as", "fred", *own, "--yes") == 0, run.err

        operators = {}
        for name in ROBOTS:
            command = [sys.executable, "-m", "pebble.cli", "up", str(Places(roots[name]).config)]
            robot = running.enter_context(Child(command, cwd=ROOT))
            running.callback(robot.wait, 30)
            running.callback(robot.terminate)
            operators[name] = Operator(
                int(broker.unencrypted or 0), BASES[name], login=("ann", broker.passwords["ann"])
            )
            running.callback(operators[name].close)

        def driven(reached: Callable[[], bool]) -> bool:
            """Both are driven until this is so."""

            def look() -> bool:
                for operator in operators.values():
                    operator.send("incoming/drive-values", {"x": 0, "z": 0.5}, qos=0)
                return reached()

            return until(look, 60, step=0.1)

        assert driven(lambda: all(board.turning() for board in boards.values()))
        for stopped, other in (ROBOTS, ROBOTS[::-1]):
            operator, board, goes_on = operators[stopped], boards[stopped], boards[other]
            operator.send("incoming/estop", {"by": "ann"})
            assert driven(lambda board=board: not board.turning()), stopped  # type: ignore[misc]
            since = goes_on.drives()[-1][0]
            assert driven(lambda board=goes_on, since=since: len(board.drives(since)) > 10), other  # type: ignore[misc]
            assert (board.turning(), goes_on.turning()) == (False, True)
            state = operator.last("outgoing/estop/serial")
            assert state is not None
            operator.send("incoming/estop-reset", {name: state.json[name] for name in ("boot", "count")})
            operator.send("incoming/drive-values", {"x": 0, "z": 0})
            assert driven(lambda board=board: board.turning()), "each is free again"  # type: ignore[misc]
        assert until(lambda: not any(board.turning() for board in boards.values())), "without commands both rest"
